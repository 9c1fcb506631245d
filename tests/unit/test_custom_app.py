"""The example of an application on hooks: a speed display."""

import importlib.util
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from evlcp_sdk.values import Frame, Range, SoftSymbols

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "custom_app.py"


@pytest.fixture(scope="module")
def app() -> ModuleType:
    spec = importlib.util.spec_from_file_location("custom_app", SCRIPT)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def frame(t_us: float, distance_m: float, transmitter: int = 0) -> Frame:
    soft = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), 1.0)
    measured = Range(distance_m, 0.05, 10)
    return Frame(transmitter, 0, 0, t_us, soft, measured, None, 640.0, 360.0)


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


def test_slope_and_deviation_are_those_of_numpy(app: ModuleType) -> None:
    rng = np.random.default_rng(0)
    display = app.SpeedDisplay(frames=20)
    t_us = 3200.0 * np.arange(30)
    for bar, speed in ((0, 8.0), (1, -3.0)):
        distance_m = 50 - speed * t_us * 1e-6 + rng.normal(0, 0.05, 30)
        for t, d in zip(t_us, distance_m, strict=True):
            display.evlcp_stage_finished("frame", frame(t, d, bar))
            display.evlcp_stage_finished("frame", frame(t, math.nan, bar))
            display.evlcp_stage_finished("ranging", Range(1.0, 0.1, 1))
        (slope, _), covariance = np.polyfit(t_us[-20:] * 1e-6, distance_m[-20:], 1, cov=True)
        assert display.speed(bar) == pytest.approx((-slope, math.sqrt(covariance[0, 0])), rel=1e-6)


def test_the_plugins_commands_are_there_and_a_fault_is_one_line(tmp_path: Path) -> None:
    said = run("--help").stdout
    assert "speed" in said
    assert "board" in said
    done = run("speed", tmp_path / "none.raw")
    assert done.returncode == 3
    assert "none.raw" in done.stderr
    assert "Traceback" not in done.stderr
