"""Boxes in the image: areas that blink, what of a box is whose, and where among its rows a bar is."""

import math
from collections.abc import Iterable
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import Events, Region

Box = tuple[int, int, int, int]
"""(left, top, right, bottom), px, the last two just outside."""

CELL_SHIFT = 2
"""Cells of 4 x 4 px: no larger than the gap at which two bars are two, and few enough to label each step."""

_SHOWN = 0.5
"""Pixels a row, by those of rows that are lit, from which on rows that were dark are lit again: half."""


def clear_of(box: Box, others: list[Box]) -> Box:
    """The largest part of a box, cut straight, that is clear of others."""
    for left, top, right, bottom in others:
        if overlap(box, (left, top, right, bottom)):
            u, v, w, z = box
            parts = [(u, v, min(w, left), z), (max(u, right), v, w, z)]
            parts += [(u, v, w, min(z, top)), (u, max(v, bottom), w, z)]
            box = max(parts, key=lambda b: max(b[2] - b[0], 0) * max(b[3] - b[1], 0))
            if box[0] >= box[2] or box[1] >= box[3]:
                return u, v, u, v
    return box


def cut_off(box: Box, bar: Box, others: list[Box]) -> Box:
    """A box around a bar without what belongs to others beside, above or below it.

    Where they seem to overlap, one of them is not where it should be, as two bars do not stand in one place;
    one that reaches over the middle is one in another column or row, which cuts nothing off. Nor is a box cut
    of which others on two sides would leave nothing: most of them are parts of one bar.
    """
    left, top, right, bottom = box
    for other in others:
        if other == bar or not overlap(box, other):
            continue
        beside = max(other[0] - bar[2], bar[0] - other[2]), (bar[2] - bar[0]) / 2
        below = max(other[1] - bar[3], bar[1] - other[3]), (bar[3] - bar[1]) / 2
        if below[0] >= beside[0] and -below[0] < below[1]:
            if other[1] > bar[1]:
                bottom = min(bottom, other[1])
            else:
                top = max(top, other[3])
        elif beside[0] > below[0] and -beside[0] < beside[1]:
            if other[0] > bar[0]:
                right = min(right, other[0])
            else:
                left = max(left, other[2])
    return (left, top, right, bottom) if left < right and top < bottom else box


def hits_in(hits: NDArray[np.int16], box: Box) -> int:
    """How many there are in the cells that a box touches."""
    left, top, right, bottom = (edge >> CELL_SHIFT for edge in (box[0], box[1], box[2] - 1, box[3] - 1))
    return int(hits[top : bottom + 1, left : right + 1].sum())


def joined(boxes: Iterable[Box], gap: int) -> list[Box]:
    """Boxes with less than a gap between them as one."""
    done: list[Box] = []
    for box in boxes:
        while near := [b for b in done if overlap(grown(box, gap), b)]:
            done = [b for b in done if b not in near]
            box = around([box, *near])
        done.append(box)
    return done


def around(boxes: list[Box]) -> Box:
    """The least box that holds some."""
    lefts, tops, rights, bottoms = zip(*boxes, strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def box_around(x_px: float, y_px: float, width_px: float, height_px: float) -> Box:
    """The pixels of a place of some size."""
    return (
        int(x_px - width_px / 2),
        int(y_px - height_px / 2),
        int(x_px + width_px / 2) + 1,
        int(y_px + height_px / 2) + 1,
    )


def box_of(region: Region) -> Box:
    """The pixels of a region."""
    return box_around(region.x_px, region.y_px, region.width_px, region.height_px)


def grown(box: Box, by: int) -> Box:
    """A box that reaches further to each side, as far as the sensor's first row and column."""
    left, top, right, bottom = box
    return max(left - by, 0), max(top - by, 0), right + by, bottom + by


def inside(events: Events, box: Box) -> NDArray[np.bool_]:
    """Which events are in a box, bool (n,)."""
    left, top, right, bottom = box
    found: NDArray[np.bool_] = (
        (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
    )
    return found


def overlap(a: Box, b: Box) -> bool:
    """Whether two boxes share a pixel."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def find_areas(
    hits: NDArray[np.int16], most: int, size_px: tuple[int, int], shift: int = CELL_SHIFT
) -> tuple[list[Box], int]:
    """Boxes around connected cells with hits, those with the most of too many; and how many are left out.

    Args:
        hits: Of cells of 2^shift px, int16 (rows, columns).
        most: How many boxes there may be.
        size_px: Columns and rows of the sensor.
        shift: See there.
    """
    # Of 2 x 2 cells, one at the most begins an area.
    rows, columns = hits.shape
    room = ((rows + 1) // 2) * ((columns + 1) // 2)
    boxes, total = np.empty((room, 4), np.int64), np.empty(room, np.int64)
    many = _kernels.areas(hits > 0, hits, boxes, total)
    boxes = boxes[:many]
    if many > most:
        boxes = boxes[np.sort(np.argsort(-total[:many], kind="stable")[:most])]
    return [tuple(box) for box in np.minimum(boxes << shift, size_px * 2).tolist()], max(many - most, 0)


def likeliest_row(
    rows: NDArray[np.int64], top: int, height: int, expected_px: float, stray_px: float, *, sized: bool
) -> float:
    """Middle of the rows that hold a bar, by the pixels in each from `top` on, int64 (n,).

    Pixels in the bar's rows and in others are Poisson variables, half a pixel for none, which says what one
    more inside says for a place. Of a bar that is not `sized`, whose height may be wrong, the places of the
    most pixels count alone, and of them the nearest one. `stray_px` is how far it is off as a rule.
    """
    # Of a few dozen places: lists are quicker than arrays.
    n, total = min(height, len(rows)), [0, *accumulate(rows.tolist())]
    inside = [below - above for above, below in zip(total[:-n], total[n:], strict=True)]
    most, beyond = max(inside), max(len(rows) - n, 1)
    other = (total[-1] - most) / beyond
    told = max(math.log((most / n + 0.5 / n) / (other + 0.5 / n)), 0.0) if sized else 0.0
    first_px = top + (n - 1) / 2
    places = [(held, at - (expected_px - first_px)) for at, held in enumerate(inside)]
    if told == 0:
        worth = [-abs(off) if held == most else -math.inf for held, off in places]
    else:
        worth = [told * held - (off / stray_px) * (off / stray_px) / 2 for held, off in places]
    return first_px + worth.index(max(worth))


def shows_again(
    rows: NDArray[np.int64], centre: float, height_px: float, lit_px: tuple[float, float]
) -> bool:
    """Whether rows of a bar that were dark in its newest frame hold half as many pixels as the others."""
    edges = centre + np.array([-height_px / 2, *lit_px, height_px / 2])
    first, upper, lower, last = np.clip(np.round(edges).astype(int), 0, len(rows))
    hidden, lit = max(upper - first, 0) + max(last - lower, 0), lower - upper
    if hidden <= 0 or lit <= 0:
        return False
    inside = int(rows[upper:lower].sum())
    outside = int(rows[first:upper].sum()) + int(rows[lower:last].sum())
    return bool(outside * lit > _SHOWN * inside * hidden)
