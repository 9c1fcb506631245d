"""The example of an application on hooks: a speed display."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "custom_app.py"


def run(*args: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, SCRIPT, *args], capture_output=True, text=True, check=False, timeout=120
    )


def test_it_shows_the_speed_of_the_recording(demo_raw: Path) -> None:
    done = run("speed", demo_raw)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    truth = json.loads(demo_raw.with_suffix(".truth.json").read_text())
    assert len(lines) >= 21
    true_m_s = -np.polyfit(truth["t_s"], truth["distance_m"][0], 1)[0]
    assert true_m_s == pytest.approx(30 / 3.6, rel=0.01)
    assert lines[0].endswith("too early for a speed")
    shown = [re.search(r"([\d.-]+) ± +([\d.]+) m/s +([\d.-]+) km/h", line) for line in lines[2:]]
    speed, sigma, km_h = np.array([[float(s) for s in found.groups()] for found in shown if found]).T
    assert len(speed) == len(lines) - 2
    assert abs(speed[-1] - true_m_s) < 1.0
    assert 0.05 < sigma[-1] < 0.5
    # The first six, as one of them is good to a third only.
    assert sigma[-1] < sigma[:6].mean() / 5
    assert km_h == pytest.approx(3.6 * speed, abs=0.1)


def test_the_plugins_commands_are_there_and_a_fault_is_one_line(tmp_path: Path) -> None:
    said = run("--help").stdout
    assert "speed" in said
    assert "board" in said
    done = run("speed", tmp_path / "none.raw")
    assert done.returncode == 3
    assert "none.raw" in done.stderr
    assert "Traceback" not in done.stderr
