"""Decoded frames held against the truth of a recording: two scores of the same rows.

The plain score counts every row, and every cluster of every frame: a symbol that is not given counts as all
bits wrong. The road score knows what a road adds: rows that are said to be reflections are left out, a symbol
that is not given is erased and no error, and one of a hidden cluster is claimed.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.link.shared import differences
from evlcp_sdk.plugin.records import SUMMARY
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results.folder import read_summary
from evlcp_sdk.sim.truth import Truth
from evlcp_sdk.study.frames import GivenFrame
from evlcp_sdk.study.match import match
from evlcp_sdk.study.measure import bar_tallies
from evlcp_sdk.study.tally import SEGMENT_M, Statistics, Tally

__all__ = ["Score", "links_of_result", "score_frames"]

_FARTHEST_M = 200
"""Segments from here on are not written."""


@dataclass(frozen=True)
class Score:
    """Decoded frames held against the truth.

    Attributes:
        rows: Decoded frames.
        unmatched: Those of them that match no true frame.
        echoes: Those that are said to be reflections and were left out; 0 in the plain score.
        bars: One per bar that shone, its tallies by segment of distance.
    """

    rows: int
    unmatched: int
    echoes: int
    bars: tuple[Statistics, ...]

    @classmethod
    def of(
        cls,
        frames: Iterable[GivenFrame],
        truth: Truth,
        *,
        road: bool,
        links: Mapping[str, Link] | None = None,
    ) -> "Score":
        """Score decoded frames.

        Args:
            frames: The decoded frames.
            truth: What was sent.
            road: The road score, not the plain one.
            links: The receiver's links by name, where it has several; None for one.
        """
        frames = list(frames)
        found = match(frames, truth, road=road, links=links)
        bars = (Statistics.of(bar_tallies(*one)) for one in zip(found.bars, found.pairs, strict=True))
        return cls(len(frames), found.unmatched, found.echoes, tuple(bars))

    def to_plain(self) -> dict[str, Any]:
        """The figures of the plain score as JSON values, rounded; null where nothing was measured."""
        return {"rows": self.rows, "unmatched": self.unmatched, "bars": [_plain(bar) for bar in self.bars]}

    def to_road(self) -> dict[str, Any]:
        """The figures of the road score as JSON values, rounded; null where nothing was measured."""
        return {
            "rows": self.rows,
            "unmatched": self.unmatched,
            "echoes": self.echoes,
            "bars": [_road(bar) for bar in self.bars],
        }


def score_frames(
    frames: Iterable[GivenFrame], truth: Truth, links: Mapping[str, Link] | None = None
) -> dict[str, Any]:
    """Both scores as JSON values: the plain one's keys, and the road score under `road`.

    Args:
        frames: The decoded frames.
        truth: What was sent.
        links: The receiver's links by name, where it has several: each bar's row names its; None for one.
    """
    frames = list(frames)
    plain, road = (Score.of(frames, truth, road=road, links=links) for road in (False, True))
    found = plain.to_plain() | {"road": road.to_road()}
    if links:
        lit = [bar for bar in truth.bars if bar.lit]
        for rows in (found["bars"], found["road"]["bars"]):
            for bar, row in zip(lit, rows, strict=True):
                row["link"] = next((n for n, one in links.items() if not differences(bar.link, one)), None)
    return found


def _rounded(value: float, digits: int) -> float | None:
    return None if math.isnan(value) else round(value, digits)


def _segments(bar: Statistics) -> dict[str, dict[str, Any]]:
    return {
        f"{start}-{start + SEGMENT_M}m": {
            "n": tally.ranged,
            "rmse_m": _rounded(tally.rmse_m, 4),
            "bias_m": _rounded(tally.bias_m, 4),
        }
        for start, tally in bar.segments.items()
        if tally.ranged and 0 <= start < _FARTHEST_M
    }


def _plain(bar: Statistics) -> dict[str, Any]:
    tally = bar.total()
    errors, bits = tally.bit_errors + tally.erased_bits, tally.bits + tally.erased_bits
    return {
        "frames_sent": tally.frames_sent,
        "frames_found": tally.frames_found,
        "bit_errors": errors,
        "bits": bits,
        "ber": _rounded(Tally(bits=bits, bit_errors=errors).ber, 6),
        "rmse_m": _rounded(tally.rmse_m, 4),
        "ranged": tally.ranged,
        "over_half_metre": _rounded(tally.gross_share, 4),
        "segments": _segments(bar),
    }


def _road(bar: Statistics) -> dict[str, Any]:
    tally = bar.total()
    return {
        "frames_sent": tally.frames_sent,
        "frames_found": tally.frames_found,
        "bit_errors": tally.bit_errors,
        "bits": tally.bits,
        "ber": _rounded(tally.ber, 6),
        "erased": _rounded(tally.erased_share, 5),
        "claimed": _rounded(tally.claimed_share, 5),
        "rmse_m": _rounded(tally.rmse_m, 4),
        "bias_m": _rounded(tally.bias_m, 4),
        "worst_m": _rounded(tally.worst_m, 3),
        "nees": _rounded(tally.nees, 2),
        "ranged": tally.ranged,
        "over_half_metre": _rounded(tally.gross_share, 4),
        "segments": _segments(bar),
    }


def links_of_result(folder: Path | str, registry: Registry | None = None) -> dict[str, Link]:
    """The links that a result was received with, from its `summary.json`; none without that file.

    Of one link, the name is empty.

    Args:
        folder: What `evlcp receive -o` wrote.
        registry: Where algorithms are found; None for all that are installed.

    Raises:
        InputError: The file cannot be read, or does not say a configuration.
        ConfigError: The configuration cannot be resolved here.
    """
    summary = read_summary(folder)
    if summary is None:
        return {}
    path, several = Path(folder) / SUMMARY, summary.get("links")
    if not isinstance(several, dict):
        return {"": _link_of(path, "", summary, registry)}
    return {name: _link_of(path, f"links.{name}.", part, registry) for name, part in several.items()}


def _link_of(path: Path, where: str, part: Any, registry: Registry | None) -> Link:
    table = part.get("configuration") if isinstance(part, dict) else None
    if not isinstance(table, dict):
        raise InputError(f"{path}: {where}configuration: expected a table")
    try:
        return resolve(table, registry, source=str(path))
    except ConfigError as fault:
        lines = (
            line if line.startswith(str(path)) else f"{path}: {line}" for line in str(fault).splitlines()
        )
        raise ConfigError("\n".join(lines)) from fault
