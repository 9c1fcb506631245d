"""Scores against the independent scorer, and by hand."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.sim import Scene, load_scene, truth_of
from evlcp_sdk.study.score import read_frames, read_truth, score_frames

SHARED = Path(__file__).parents[4] / "shared"
SCORER = SHARED / "tools" / "score.py"
COLUMNS = ("transmitter", "t_us", "symbols", "distance_m", "x_px", "y_px")


def true_rows(found: dict[str, Any], seed: int = 0) -> list[dict[str, str]]:
    """Rows of a receiver that makes some faults of every kind."""
    rng = np.random.default_rng(seed)
    rows = []
    t_us = np.array(found["t_s"]) * 1e6
    for i, bar in enumerate(found["bars"]):
        rate = 1e4 * (1 + bar["ppm"] * 1e-6)
        for q, packet in enumerate(bar["symbols"]):
            for f, frame in enumerate(packet):
                begin = (q * bar["packet_chips"] + 26 + 32 * f - bar["start_chip"]) / rate * 1e6
                if rng.random() < 0.1:
                    continue
                symbols = [s ^ int(rng.random() < 0.05) for s in frame]
                if rng.random() < 0.05:
                    symbols = symbols[: rng.integers(0, 16)]
                distance = np.interp(begin + 800, t_us, found["distance_m"][i]) + rng.normal(0, 0.3)
                x, y = (np.interp(begin, t_us, found["bar_centre_px"][i][axis]) for axis in (0, 1))
                late = rng.choice([15.0, 900.0], p=[0.95, 0.05])
                away = rng.choice([0.0, 100.0], p=[0.95, 0.05])
                rows.append(
                    {
                        "transmitter": str(i),
                        "t_us": repr(float(begin + late + found["scene"]["t0_us"])),
                        "symbols": " ".join(map(str, symbols)),
                        "distance_m": "" if rng.random() < 0.05 else repr(float(distance)),
                        "x_px": repr(float(x + away)),
                        "y_px": repr(float(y)),
                    }
                )
                if rng.random() < 0.03:
                    rows.append(rows[-1])
    return rows


def write(folder: Path, rows: list[dict[str, str]], found: dict[str, Any]) -> tuple[Path, Path]:
    lines = [",".join(COLUMNS)] + [",".join(row[c] for c in COLUMNS) for row in rows]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    (folder / "REC.truth.json").write_text(json.dumps(found))
    return folder, folder / "REC.truth.json"


def scene_truths() -> dict[str, dict[str, Any]]:
    two = truth_of(
        load_scene("two-bars", ["duration_s=0.2", "motion.distance_m=61.0", "t0_us=16777000"])
    ).to_table()
    dark = truth_of(Scene()).to_table()
    dark["bars"][0]["led_w_m2"] = 1e-9
    return {"two": two, "dark": dark, "one": truth_of(load_scene("tunnel", ["bars.profile=wh8"])).to_table()}


def independent(folder: Path, path: Path) -> dict[str, Any]:
    """What the scorer says, run as the program that it is."""
    command = [sys.executable, SCORER, folder, path, "--json"]
    found: dict[str, Any] = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return found


@pytest.mark.skipif(not SCORER.exists(), reason="the scorer of ../shared is not there")
@pytest.mark.parametrize("name", ["two", "dark", "one"])
def test_the_numbers_are_those_of_the_independent_scorer(
    name: str, tmp_path: Path, evlcp: Callable[..., Any]
) -> None:
    found = scene_truths()[name]
    folder, path = write(tmp_path, true_rows(found), found)
    theirs = independent(folder, path)
    assert score_frames(read_frames(folder), read_truth(path)).to_dict() == theirs
    done = evlcp("score", folder, path, "--json")
    assert json.loads(done.out) == theirs
    if name == "two":
        assert theirs["bars"][0]["bit_errors"] > 0
        assert theirs["unmatched"] > 0
        assert evlcp("score", folder, path).out.startswith(f"rows {theirs['rows']}, matching no true frame")


@pytest.mark.skipif(not SCORER.exists(), reason="the scorer of ../shared is not there")
@pytest.mark.parametrize("path", sorted(SHARED.glob("recordings/*.truth.json")), ids=lambda p: p.stem)
def test_the_numbers_agree_on_the_recordings(path: Path, tmp_path: Path) -> None:
    found = read_truth(path)
    folder, copy = write(tmp_path, true_rows(found, 3), found)
    assert score_frames(read_frames(folder), found).to_dict() == independent(folder, copy)


def test_a_perfect_result_scores_perfectly() -> None:
    found = truth_of(load_scene("night")).to_table()
    (bar,) = found["bars"]
    t_us = np.array(found["t_s"]) * 1e6
    rows = []
    for q, packet in enumerate(bar["symbols"]):
        for f, frame in enumerate(packet):
            begin = (q * 346 + 26 + 32 * f - bar["start_chip"]) * 100
            rows.append(
                {
                    "t_us": str(begin),
                    "symbols": " ".join(map(str, frame)),
                    "distance_m": str(np.interp(begin + 800, t_us, found["distance_m"][0]) + 0.5),
                    "x_px": str(found["bar_centre_px"][0][0][0]),
                    "y_px": str(found["bar_centre_px"][0][1][0]),
                }
            )
    inside = [r for r in rows if 0 <= float(r["t_us"]) < 250_000 - 3400]
    result = score_frames(inside, found)
    (score,) = result.bars
    assert score.frames_sent >= score.frames_found >= len(inside) - 15
    assert (score.ber, result.rows) == (0.0, len(inside))
    assert score.rmse_m == pytest.approx(0.5)
    assert score.over_half_metre == pytest.approx(1, abs=0.6)


@pytest.mark.parametrize(
    ("frames", "found", "says"),
    [
        (None, "{}", "frames.csv: cannot be read"),
        ("t_us,symbols\n", "{}", "frames.csv: without the columns distance_m, x_px, y_px"),
        (",".join(COLUMNS) + "\n", "{}", "not a scene's truth: bar_centre_px, bars, distance_m, scene, t_s"),
        (",".join(COLUMNS) + "\n", "[]", "not a scene's truth"),
        (
            ",".join(COLUMNS) + "\n",
            '{"scene": {}, "bars": 3, "t_s": [], "distance_m": [], "bar_centre_px": []}',
            "t.json: not a scene's truth: bars = 3: expected a list",
        ),
        (",".join(COLUMNS) + "\n", "{", "not JSON"),
        (",".join(COLUMNS) + "\n", None, "cannot be read"),
    ],
)
def test_what_cannot_be_scored_is_told(
    frames: str | None, found: str | None, says: str, tmp_path: Path, evlcp: Callable[..., Any]
) -> None:
    if frames is not None:
        (tmp_path / "frames.csv").write_text(frames)
    if found is not None:
        (tmp_path / "t.json").write_text(found)
    done = evlcp("score", tmp_path, tmp_path / "t.json")
    assert done.code == 3
    assert says in done.err


def test_a_row_without_a_number_is_told() -> None:
    found = truth_of(Scene(duration_s=0.05)).to_table()
    row = {"t_us": "soon", "symbols": "", "distance_m": "", "x_px": "0", "y_px": "0"}
    with pytest.raises(InputError, match="soon"):
        score_frames([row], found)
    with pytest.raises(InputError, match="x_px"):
        score_frames([{k: v for k, v in row.items() if k != "x_px"} | {"t_us": "0"}], found)
