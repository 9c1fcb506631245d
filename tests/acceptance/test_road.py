"""What the default link reaches on the road, by the benchmark, with which an independent scorer agrees."""

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT

ROAD = ROOT.parent / "shared" / "recordings" / "road"

TRUE_WARNINGS = {"bracket-45m": ["clusters-hidden"], "rate-cap-3mev-50m": ["saturated"]}
"""What is wrong with two of the recordings; with all others nothing is."""


@pytest.mark.skipif(
    not ROAD.is_dir(), reason="needs the recordings with truth in ../shared, which users do not have"
)
def test_figures_are_reached_on_a_road() -> None:
    command = [sys.executable, ROOT / "benchmarks" / "road.py", "--rounds", "0", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    found = next(iter(json.loads(done.stdout).values()))["recordings"]
    assert len(found) > 30
    worse = []
    for one in found:
        name = one["recording"]
        if "fault" in one:
            worse.append(f"{name}: {one['fault']}")
            continue
        assert one["independent"] == "agrees", name
        assert one["warnings"] == TRUE_WARNINGS.get(name, []), name
        for i, bar in enumerate(one["bars"]):
            if bar["missed"]:
                worse.append(f"{name}, bar {i}: {', '.join(sorted(bar['missed']))}: {bar}")
    assert not worse, "\n".join(worse)
