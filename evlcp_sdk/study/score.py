"""Decoded frames held against the truth of a recording.

Each row of `frames.csv` is put beside the true frame that began nearest in time, on the bar nearest in the
image. Scene truths have the schema of `evlcp simulate`.
"""

import csv
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import InputError

__all__ = ["BarScore", "Score", "Segment", "read_frames", "read_truth", "score_frames"]

BITS_PER_SYMBOL = {"wh4x2": 6, "wh8": 4, "raw8": 8}

_PREAMBLE_CHIPS = 26
_SEGMENT_CHIPS = 16
"""Of a pilot, and of an info segment."""
_CHIP_RATE_HZ = 1e4
_LATE_US = 200.0
"""A frame counts as sent when the scene goes on for this long after its end."""
_NEAREST_US = 800.0
_NEAREST_PX = 60.0
_RANGED_AT_US = 800.0
"""When in a frame its distance is compared: in the middle of the pilot."""
_HALF_METRE = 0.5


@dataclass(frozen=True)
class Segment:
    """Distances of one 10 m stretch.

    Attributes:
        n: How many.
        rmse_m: Root mean square error, m.
        bias_m: Mean error, m.
    """

    n: int
    rmse_m: float
    bias_m: float


@dataclass(frozen=True, eq=False)
class BarScore:
    """What was received of one bar.

    Attributes:
        frames_sent: Frames that were wholly on air.
        frames_found: Frames of these that were decoded.
        bit_errors: Wrong bits of the found frames.
        bits: Bits of the found frames.
        true_m: True distance of each ranged frame, m, float64 (n,).
        error_m: Error of each, m, float64 (n,).
        filtered_error_m: Errors of the filtered distances, m, float64 (f,); none without a filter.
    """

    frames_sent: int
    frames_found: int
    bit_errors: int
    bits: int
    true_m: NDArray[np.float64]
    error_m: NDArray[np.float64]
    filtered_error_m: NDArray[np.float64]

    @property
    def ber(self) -> float | None:
        """Bit error rate of the found frames; None without any."""
        return self.bit_errors / self.bits if self.bits else None

    @property
    def rmse_m(self) -> float | None:
        """Root mean square error of the distances, m; None without any."""
        return math.sqrt(float((self.error_m**2).mean())) if len(self.error_m) else None

    @property
    def gross(self) -> int:
        """Distances that are half a metre off or more."""
        return int((np.abs(self.error_m) >= _HALF_METRE).sum())

    @property
    def over_half_metre(self) -> float | None:
        """Share of the distances that are half a metre off or more; None without any."""
        return self.gross / len(self.error_m) if len(self.error_m) else None

    def segments(self) -> dict[str, Segment]:
        """Errors of every 10 m stretch up to 200 m that has a distance, by name, e.g. `40-50m`."""
        found = {}
        for low in range(0, 200, 10):
            error = self.error_m[(self.true_m >= low) & (self.true_m < low + 10)]
            if error.size:
                rmse = math.sqrt(float((error**2).mean()))
                found[f"{low}-{low + 10}m"] = Segment(int(error.size), rmse, float(error.mean()))
        return found


@dataclass(frozen=True, eq=False)
class Score:
    """Decoded frames held against the truth.

    Attributes:
        rows: Rows of `frames.csv`.
        unmatched: Rows that match no true frame.
        bars: One a bar that shone.
    """

    rows: int
    unmatched: int
    bars: tuple[BarScore, ...]

    def to_dict(self) -> dict[str, Any]:
        """The score as JSON values, rounded: rates to 6 digits after the point, lengths to 4."""

        def rounded(value: float | None, digits: int) -> float | None:
            return None if value is None else round(value, digits)

        return {
            "rows": self.rows,
            "unmatched": self.unmatched,
            "bars": [
                {
                    "frames_sent": bar.frames_sent,
                    "frames_found": bar.frames_found,
                    "bit_errors": bar.bit_errors,
                    "bits": bar.bits,
                    "ber": rounded(bar.ber, 6),
                    "rmse_m": rounded(bar.rmse_m, 4),
                    "ranged": len(bar.error_m),
                    "over_half_metre": rounded(bar.over_half_metre, 4),
                    "segments": {
                        name: {"n": s.n, "rmse_m": round(s.rmse_m, 4), "bias_m": round(s.bias_m, 4)}
                        for name, s in bar.segments().items()
                    },
                }
                for bar in self.bars
            ],
        }


def _sent_frames(bar: Mapping[str, Any], duration_us: float) -> list[tuple[float, int, int]]:
    """(begin, us, packet, frame) of every frame that is wholly inside the scene."""
    rate = _CHIP_RATE_HZ * (1 + bar["ppm"] * 1e-6)
    form = PacketFormat(
        _PREAMBLE_CHIPS, _SEGMENT_CHIPS, _SEGMENT_CHIPS, bar["frames"], pilot_every=bar.get("pilot_every", 1)
    )
    sent = []
    for q in range(len(bar["symbols"])):
        for f in range(bar["frames"]):
            first, last = form.frame_start_chip(f), form.frame_start_chip(f + 1)
            begin = (q * bar["packet_chips"] + first - bar["start_chip"]) / rate * 1e6
            if begin >= 0 and begin + (last - first) / rate * 1e6 + _LATE_US < duration_us:
                sent.append((begin, q, f))
    return sent


def score_frames(rows: Iterable[Mapping[str, str]], truth: Mapping[str, Any]) -> Score:
    """Hold rows of `frames.csv` against a recording's truth.

    Args:
        rows: Columns t_us, symbols, distance_m, x_px, y_px, distance_filtered_m if there, as text; others are
            ignored.
        truth: What `REC.truth.json` holds.

    Raises:
        InputError: A column or a key is missing, or a value is no number.
    """
    rows = list(rows)
    try:
        return _score(rows, truth)
    except KeyError as fault:
        raise InputError(f"score: column or key {fault} is missing") from fault
    except (TypeError, ValueError, IndexError) as fault:
        raise InputError(f"score: {fault}") from fault


def _score(rows: list[Mapping[str, str]], truth: Mapping[str, Any]) -> Score:
    t0_us = truth["scene"]["t0_us"]
    duration_us = truth["scene"]["duration_s"] * 1e6
    ts_us = np.array(truth["t_s"]) * 1e6
    bars = [b for b in truth["bars"] if b.get("led_w_m2") is None or b["led_w_m2"] > 1e-6]
    centres, depths = truth["bar_centre_px"], truth["distance_m"]
    sent = [_sent_frames(bar, duration_us) for bar in bars]
    starts = [np.array([begin for begin, _, _ in frames]) for frames in sent]
    hits: list[set[int]] = [set() for _ in bars]
    errors, bits = [0] * len(bars), [0] * len(bars)
    ranged: list[list[tuple[float, float]]] = [[] for _ in bars]
    filtered: list[list[float]] = [[] for _ in bars]
    unmatched = 0
    for row in rows:
        t = float(row["t_us"]) - t0_us
        if not bars:
            unmatched += 1
            continue
        x, y = float(row["x_px"]), float(row["y_px"])
        away = [
            float(np.hypot(x - np.interp(t, ts_us, centres[i][0]), y - np.interp(t, ts_us, centres[i][1])))
            for i in range(len(bars))
        ]
        i = int(np.argmin(away))
        j = int(np.argmin(np.abs(starts[i] - t))) if len(starts[i]) else -1
        near = away[i] <= _NEAREST_PX
        if j < 0 or abs(starts[i][j] - t) > _NEAREST_US or not near or j in hits[i]:
            # A frame cut by the recording's ends is neither found nor a ghost.
            cut = near and (t < _LATE_US or t + 3400 > duration_us) and j not in hits[i]
            unmatched += not cut
            continue
        hits[i].add(j)
        begin, q, f = sent[i][j]
        width = BITS_PER_SYMBOL[bars[i]["profile"]]
        wanted = bars[i]["symbols"][q][f]
        heard = [int(v) for v in row["symbols"].split()]
        for k, symbol in enumerate(wanted):
            errors[i] += (symbol ^ heard[k]).bit_count() if k < len(heard) else width
        bits[i] += width * len(wanted)
        true_m = float(np.interp(begin + _RANGED_AT_US, ts_us, depths[i]))
        if row.get("distance_filtered_m"):
            filtered[i].append(float(row["distance_filtered_m"]) - true_m)
        if row.get("distance_m"):
            ranged[i].append((true_m, float(row["distance_m"]) - true_m))
    found = []
    for i in range(len(bars)):
        pairs = np.array(ranged[i]).reshape(-1, 2)
        counts = len(sent[i]), len(hits[i]), errors[i], bits[i]
        found.append(BarScore(*counts, pairs[:, 0], pairs[:, 1], np.array(filtered[i], np.float64)))
    return Score(len(rows), unmatched, tuple(found))


def read_frames(folder: Path | str) -> list[dict[str, str]]:
    """The rows of a result's `frames.csv`.

    Raises:
        InputError: It is not there, or no such table.
    """
    path = Path(folder) / "frames.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            missing = {"t_us", "symbols", "distance_m", "x_px", "y_px"} - set(rows.fieldnames or ())
            if missing:
                raise InputError(f"{path}: without the columns {', '.join(sorted(missing))}")
            return list(rows)
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except (UnicodeDecodeError, csv.Error) as fault:
        raise InputError(f"{path}: not a CSV file: {fault}") from fault


def read_truth(path: Path | str) -> dict[str, Any]:
    """What a `REC.truth.json` holds.

    Raises:
        InputError: It cannot be read, or is no scene's truth.
    """
    try:
        truth = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except ValueError as fault:
        raise InputError(f"{path}: not JSON: {fault}") from fault
    wanted = {"scene", "bars", "t_s", "distance_m", "bar_centre_px"}
    missing = wanted - set(truth) if isinstance(truth, dict) else wanted
    if missing:
        raise InputError(f"{path}: not a scene's truth: {', '.join(sorted(missing))} missing")
    assert isinstance(truth, dict)
    for key in sorted(wanted):
        kind, what = (dict, "a table") if key == "scene" else (list, "a list")
        if not isinstance(truth[key], kind):
            text = f"{truth[key]!r:.40}"
            raise InputError(f"{path}: not a scene's truth: {key} = {text}: expected {what}")
    return truth
