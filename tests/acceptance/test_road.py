"""What the default link reaches on the road, by the benchmark's table; and that the table is true."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk.sim import read_truth, truth_path
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.score import score_frames
from tests.conftest import ROOT

ROAD = ROOT.parent / "shared" / "recordings" / "road"
BENCHMARK = ROOT / "benchmarks" / "road.py"


TRUE_WARNINGS = {"bracket-45m": ["clusters-hidden"], "rate-cap-3mev-50m": ["saturated"]}
"""What is wrong with two of the recordings; with all others nothing is."""


def table(*args: str | Path) -> dict[str, Any]:
    """What the benchmark prints as JSON, by recording, of its first link; speed left out."""
    command = [sys.executable, BENCHMARK, *args, "--rounds", "0", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    links = json.loads(done.stdout)
    return {one["recording"]: one for one in next(iter(links.values()))["recordings"]}


@pytest.mark.skipif(
    not ROAD.is_dir(), reason="needs the recordings with truth in ../shared, which users do not have"
)
def test_figures_are_reached_on_a_road() -> None:
    found = table()
    assert found
    worse = []
    for name, one in found.items():
        if "fault" in one:
            worse.append(f"{name}: {one['fault']}")
            continue
        assert one["independent"] != "differs", name
        assert one["warnings"] == TRUE_WARNINGS.get(name, []), name
        for i, bar in enumerate(one["bars"]):
            if bar["missed"]:
                worse.append(f"{name}, bar {i}: {', '.join(sorted(bar['missed']))}: {bar}")
    assert not worse, "\n".join(worse)


def test_the_table_says_what_the_score_says(demo_raw: Path, tmp_path: Path, evlcp: Any) -> None:
    (one,) = table(demo_raw).values()
    assert evlcp("receive", demo_raw, "-o", tmp_path).code == 0
    score = score_frames(read_frames(tmp_path), read_truth(truth_path(demo_raw)))["road"]
    (said,), (bar,) = one["bars"], score["bars"]
    assert (one["rows"], one["ghosts"], one["echoes"]) == (score["rows"], score["unmatched"], score["echoes"])
    assert said["frames_found"] == bar["frames_found"] > 15
    assert said["ber"] == bar["ber"] == 0
    for key in ("rmse_m", "bias_m", "worst_m", "nees"):
        assert said[key] == pytest.approx(bar[key], abs=0.006)
    assert said["targets"] == {"nees": [0.5, 2.0], "ghosts": 0}
