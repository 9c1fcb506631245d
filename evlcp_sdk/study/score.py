"""Scores of decoded frames against the truth of a recording: two of the same rows.

The plain score counts every row, and every cluster of every frame: a symbol that is not given counts as all
bits wrong. The road score leaves out declared reflections; a symbol that is not given is erased and no error,
and one of a hidden cluster is claimed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import InputError
from evlcp_sdk.formatting import round_or_none
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.link.shared import find_differences
from evlcp_sdk.plugin.records import SUMMARY
from evlcp_sdk.results.folder import read_summary
from evlcp_sdk.sim.truth import Truth
from evlcp_sdk.study.frames import FrameRow
from evlcp_sdk.study.match import match_frames
from evlcp_sdk.study.measure import tally_bar
from evlcp_sdk.study.tally import SEGMENT_M, Statistics, Tally

_FARTHEST_M = 200
"""Segments from here on are left out."""

_ROAD_FIGURES = ("erased", "claimed", "bias_m", "worst_m", "nees")
"""Figures of the road score alone."""


def score_frames(
    frames: Sequence[FrameRow], truth: Truth, links: Mapping[str, Link] | None = None
) -> dict[str, Any]:
    """Both scores as JSON values: the plain one's keys, and the road score under `road`."""
    plain, road = (_score_bars(frames, truth, links, road=road) for road in (False, True))
    return plain | {"road": road}


def _score_bars(
    frames: Sequence[FrameRow], truth: Truth, links: Mapping[str, Link] | None, *, road: bool
) -> dict[str, Any]:
    found = match_frames(frames, truth, road=road, links=links)
    bars = []
    for sent, pairs in zip(found.bars, found.pairs, strict=True):
        row = _bar_figures(Statistics.of(tally_bar(sent, pairs)), road=road)
        if links:
            link = sent.bar.link
            row["link"] = next((name for name, one in links.items() if not find_differences(link, one)), None)
        bars.append(row)
    echoes = {"echoes": found.echoes} if road else {}
    return {"rows": len(frames), "unmatched": found.unmatched} | echoes | {"bars": bars}


def _bar_figures(bar: Statistics, *, road: bool) -> dict[str, Any]:
    tally = bar.total()
    # A symbol that is not given counts as all bits wrong, or not at all.
    erased = 0 if road else tally.erased_bits
    counted = Tally(bits=tally.bits + erased, bit_errors=tally.bit_errors + erased)
    figures = {
        "frames_sent": tally.frames_sent,
        "frames_found": tally.frames_found,
        "bit_errors": counted.bit_errors,
        "bits": counted.bits,
        "ber": round_or_none(counted.ber, 6),
        "erased": round_or_none(tally.erased_share, 5),
        "claimed": round_or_none(tally.claimed_share, 5),
        "rmse_m": round_or_none(tally.rmse_m, 4),
        "bias_m": round_or_none(tally.bias_m, 4),
        "worst_m": round_or_none(tally.worst_m, 3),
        "nees": round_or_none(tally.nees, 2),
        "ranged": tally.ranged,
        "over_half_metre": round_or_none(tally.gross_share, 4),
        "segments": {
            f"{start}-{start + SEGMENT_M}m": {
                "n": tally.ranged,
                "rmse_m": round_or_none(tally.rmse_m, 4),
                "bias_m": round_or_none(tally.bias_m, 4),
            }
            for start, tally in bar.segments.items()
            if tally.ranged and 0 <= start < _FARTHEST_M
        },
    }
    return {key: value for key, value in figures.items() if road or key not in _ROAD_FIGURES}


def links_of_result(folder: Path | str) -> dict[str, Link]:
    """The links that a result was received with, from its `summary.json`; none without that file.

    A single link has an empty name.

    Raises:
        InputError: The file cannot be read, or has no configuration.
        ConfigError: The configuration cannot be resolved here.
    """
    summary = read_summary(folder)
    if summary is None:
        return {}
    path, several = Path(folder) / SUMMARY, summary.get("links")
    if not isinstance(several, dict):
        return {"": _link_of(path, "", summary)}
    return {name: _link_of(path, f"links.{name}.", part) for name, part in several.items()}


def _link_of(path: Path, prefix: str, part: Any) -> Link:
    table = part.get("configuration") if isinstance(part, dict) else None
    if not isinstance(table, dict):
        raise InputError(f"{path}: {prefix}configuration: expected a table")
    return resolve(table, source=str(path))
