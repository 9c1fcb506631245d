"""The example of an application on hooks: a speed display."""

import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT

SCRIPT = ROOT / "examples" / "custom_app.py"


def run(monkeypatch: pytest.MonkeyPatch, *args: str | Path) -> int:
    """Run the script; gives its exit code."""
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, args)])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    return int(end.value.code or 0)


def test_it_shows_the_speed_of_the_recording(demo_raw, monkeypatch, capsys) -> None:
    assert run(monkeypatch, "speed", demo_raw) == 0
    lines = capsys.readouterr().out.splitlines()
    truth = json.loads(demo_raw.with_suffix(".truth.json").read_text())
    assert len(lines) >= 21
    true_m_s = -np.polyfit(truth["t_s"], truth["distance_m"][0], 1)[0]
    assert lines[0].endswith("too early for a speed")
    shown = [re.search(r"([\d.-]+) ± +([\d.]+) m/s +([\d.-]+) km/h", line) for line in lines[2:]]
    speed, sigma, km_h = np.array([[float(s) for s in found.groups()] for found in shown if found]).T
    assert len(speed) == len(lines) - 2
    assert abs(speed[-1] - true_m_s) < 1.0
    assert 0.05 < sigma[-1] < 0.5
    # The first six, as one of them is good to a third only.
    assert sigma[-1] < sigma[:6].mean() / 5
    assert km_h == pytest.approx(3.6 * speed, abs=0.1)


def test_the_plugins_commands_are_there_and_a_fault_is_one_line(tmp_path, monkeypatch, capsys) -> None:
    assert run(monkeypatch, "--help") == 0
    assert {"speed", "board"} <= set(capsys.readouterr().out.split())
    assert run(monkeypatch, "speed", tmp_path / "none.raw") == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "none.raw" in line
