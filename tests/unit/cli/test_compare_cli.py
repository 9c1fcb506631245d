"""`evlcp compare` on the shipped recording and on a campaign's results."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.sim import read_truth
from evlcp_sdk.study.frames import read_frames

Evlcp = Callable[..., Any]
REC_WH8 = (
    "evlcp: REC.raw: --variant a: bar 0 was sent with another link:"
    ' modulation.id: sent with "wh4x2", received with "wh8"'
)
VARIANTS = {
    "paper": ("ranging.id=poc", "decoding.id=wh-transform"),
    "filtered": ("ranging.id=joint-scale", "tracking.id=kalman"),
}
OPTIONS = [part for name, s in VARIANTS.items() for part in ("--variant", f"{name}:{','.join(s)}")]
TIMES = {"us_per_frame", "separation_us", "decoding_us", "ranging_us", "cpu_s", "times_real_time", "best"}


@pytest.fixture
def recording(tmp_path: Path, demo_raw: Path) -> Path:
    """The shipped recording with its truth, in a folder of its own."""
    for path in (demo_raw, demo_raw.with_suffix(".truth.json")):
        shutil.copy(path, tmp_path / path.name.replace(demo_raw.stem, "REC"))
    return tmp_path / "REC.raw"


def test_the_numbers_are_those_of_receive_and_score(evlcp: Evlcp, recording: Path, tmp_path: Path) -> None:
    done = evlcp("compare", recording, *OPTIONS, "--json")
    assert (done.code, done.err) == (0, "")
    rows = {row["variant"]: row for row in json.loads(done.out)["rows"]}
    truth = read_truth(tmp_path / "REC.truth.json")
    for name, settings in VARIANTS.items():
        options = [part for setting in settings for part in ("--set", setting)]
        assert evlcp("receive", recording, "-o", tmp_path / name, *options).code == 0
        result = json.loads(evlcp("score", tmp_path / name, tmp_path / "REC.truth.json", "--json").out)
        (bar,), (road,), row = result["bars"], result["road"]["bars"], rows[name]
        assert (row["frames"], row["unmatched"]) == (result["rows"], result["unmatched"])
        assert (round(row["ber"], 6), round(row["gross_share"], 4)) == (bar["ber"], bar["over_half_metre"])
        assert row["nees"] == pytest.approx(road["nees"], rel=0.02)
        frames = read_frames(tmp_path / name)
        assert row["packets"] == len((tmp_path / name / "packets.jsonl").read_text().splitlines())
        stated = np.array([f.sigma_m for f in frames])
        assert row["sigma_m"] == pytest.approx(np.sqrt(np.mean(stated**2)), abs=5e-5)
        if name == "filtered":
            t_us = np.array([f.t_us for f in frames]) - truth.t0_us
            true_m = np.interp(t_us + 800, truth.t_us, truth.bars[0].distance_m)
            off = np.array([f.filtered_m for f in frames]) - true_m
            # A frame says its time late by the camera's latency: the car drives a third of a millimetre.
            assert row["filtered_rmse_m"] == pytest.approx(np.sqrt(np.mean(off**2)), abs=3.5e-4)
        else:
            assert row["filtered_rmse_m"] is None
        assert row["us_per_frame"] > 0
        assert row["times_real_time"] == pytest.approx(row["recorded_s"] / row["cpu_s"])
    # The bound: less than what any one reaches, and no other order of size than the best.
    bounds = {row["cramer_rao_bound_m"] for row in rows.values()}
    assert len(bounds) == 1
    best = min(row["rmse_m"] for row in rows.values())
    assert best / 3 < bounds.pop() < 1.2 * best


def test_text_and_files(evlcp: Evlcp, recording: Path, tmp_path: Path) -> None:
    second = tmp_path / "other.raw"
    shutil.copy(recording, second)
    files = [tmp_path / f"t{suffix}" for suffix in (".csv", ".html", ".json")]
    options = [part for path in files for part in ("-o", path)]
    done = evlcp("compare", recording, second, *OPTIONS, *options, "-j", "2")
    assert done.code == 0
    assert "\x1b" not in done.out
    assert done.out.count("Cramer-Rao bound") == 3
    assert f"{second}: no other.truth.json beside it, so no BER and no distance error" in done.out
    table = json.loads(files[2].read_text())
    names = [str(recording), str(second), "all"]
    assert [row["recording"] for row in table["rows"]] == [name for name in names for _ in VARIANTS]
    assert f"{table['rows'][1]['rmse_m']:.4f}*" in done.out
    assert table["rows"][2]["ber"] is None
    assert len(files[0].read_text().splitlines()) == 1 + len(table["rows"])
    assert files[1].read_text().startswith("<!DOCTYPE html>")
    # In this process or another: the same, but for the time.
    here = json.loads(evlcp("compare", recording, *OPTIONS, "--json").out)["rows"]
    for one, other in zip(here, table["rows"], strict=False):
        assert one.keys() == other.keys()
        assert {key for key, value in one.items() if value != other[key]} <= TIMES


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ((), 2, "name at least one"),
        (("--variant", "a:", "-o", "t.pdf"), 2, ".csv, .html"),
        (("--variant", "a:", "-o", "none/t.csv"), 1, "none/t.csv: cannot be written: no folder none"),
        (("REC.raw", "--variant", "a:"), 2, "REC.raw is named twice"),
        (("paper.toml",), 2, "evlcp sweep paper.toml -o R.sqlite, then evlcp compare R.sqlite"),
        (("none.sqlite",), 2, "stand alone"),
        (("--variant", "a:modulation.id=wh8"), 2, REC_WH8),
        (("--variant", "a:camera.width=640"), 2, "recorded with 1280 x 720 pixels"),
    ],
)
def test_faults(evlcp, recording, monkeypatch, arguments, code, message) -> None:
    monkeypatch.chdir(recording.parent)
    done = evlcp("compare", "REC.raw", *arguments)
    assert done.code == code
    assert message in " ".join(done.err.replace("│", " ").split())
    assert "Traceback" not in done.err
    assert done.out == ""


def test_of_several_recordings_the_others_are_compared(evlcp: Evlcp, recording: Path, tmp_path: Path) -> None:
    none, torn = tmp_path / "none.raw", tmp_path / "torn.raw"
    torn.with_suffix(".truth.json").write_text("{")
    shutil.copy(recording, torn)
    done = evlcp("compare", none, torn, recording, "--variant", "a:", "--json")
    assert done.code == 3
    first, second = done.err.splitlines()
    assert first == f"evlcp: {none}: No such file or directory"
    assert second.startswith(f"evlcp: {tmp_path}/torn.truth.json: not JSON")
    assert [row["recording"] for row in json.loads(done.out)["rows"]] == [str(recording)]
