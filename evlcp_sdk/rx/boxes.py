"""Boxes of pixels: cut and join them, find areas that blink, and a bar among the rows of one."""

import math
from collections.abc import Iterable
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import Events, Region

Box = tuple[int, int, int, int]
"""(left, top, right, bottom), px, the last two exclusive."""

CELL_SHIFT = 2
"""Cells of 4 x 4 px: no larger than the gap at which two bars are two, and few enough to label each step."""

_LIT_SHARE = 0.5
"""Rows that were dark are lit again from this share of the pixels of lit rows on."""


def subtract_boxes(box: Box, others: list[Box]) -> Box:
    """The largest rectangle left of a box when others are cut off it; empty where none is left."""
    for left, top, right, bottom in others:
        if boxes_overlap(box, (left, top, right, bottom)):
            u, v, w, z = box
            parts = [(u, v, min(w, left), z), (max(u, right), v, w, z)]
            parts += [(u, v, w, min(z, top)), (u, max(v, bottom), w, z)]
            box = max(parts, key=lambda b: max(b[2] - b[0], 0) * max(b[3] - b[1], 0))
            if box[0] >= box[2] or box[1] >= box[3]:
                return u, v, u, v
    return box


def cut_neighbours(box: Box, bar: Box, others: list[Box]) -> Box:
    """Cut off a bar's box what belongs to other bars beside, above or below it.

    Bars that seem to overlap are not where they should be, as two do not stand in one place; one that reaches
    over the middle stands in another column or row, and cuts nothing off. A box of which others on two sides
    would leave nothing stays whole: most of these are parts of one bar.
    """
    left, top, right, bottom = box
    for other in others:
        if other == bar or not boxes_overlap(box, other):
            continue
        gap_x, half_x = max(other[0] - bar[2], bar[0] - other[2]), (bar[2] - bar[0]) / 2
        gap_y, half_y = max(other[1] - bar[3], bar[1] - other[3]), (bar[3] - bar[1]) / 2
        if gap_y >= gap_x and -gap_y < half_y:
            if other[1] > bar[1]:
                bottom = min(bottom, other[1])
            else:
                top = max(top, other[3])
        elif gap_x > gap_y and -gap_x < half_x:
            if other[0] > bar[0]:
                right = min(right, other[0])
            else:
                left = max(left, other[2])
    return (left, top, right, bottom) if left < right and top < bottom else box


def count_hits(hits: NDArray[np.int16], box: Box) -> int:
    """Number of hits in the cells that a box touches."""
    left, top, right, bottom = (edge >> CELL_SHIFT for edge in (box[0], box[1], box[2] - 1, box[3] - 1))
    return int(hits[top : bottom + 1, left : right + 1].sum())


def join_boxes(boxes: Iterable[Box], gap: int) -> list[Box]:
    """Join boxes with less than a gap between them."""
    joined: list[Box] = []
    for box in boxes:
        while near := [other for other in joined if boxes_overlap(grow_box(box, gap), other)]:
            joined = [other for other in joined if other not in near]
            box = bounding_box([box, *near])
        joined.append(box)
    return joined


def bounding_box(boxes: list[Box]) -> Box:
    """The smallest box that holds all of some."""
    lefts, tops, rights, bottoms = zip(*boxes, strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def box_around(x_px: float, y_px: float, width_px: float, height_px: float) -> Box:
    """The box around a centre."""
    return (
        int(x_px - width_px / 2),
        int(y_px - height_px / 2),
        int(x_px + width_px / 2) + 1,
        int(y_px + height_px / 2) + 1,
    )


def box_of(region: Region) -> Box:
    """The box of a region."""
    return box_around(region.x_px, region.y_px, region.width_px, region.height_px)


def clip_box(box: Box, size_px: tuple[int, int]) -> Box:
    """The part of a box that is on a sensor of so many columns and rows; an empty one off it."""
    (left, top, right, bottom), (width, height) = box, size_px
    return (
        min(max(left, 0), width),
        min(max(top, 0), height),
        min(max(right, 0), width),
        min(max(bottom, 0), height),
    )


def grow_box(box: Box, seam_px: int) -> Box:
    """Extend a box to each side, not beyond the sensor's first row and column."""
    left, top, right, bottom = box
    return max(left - seam_px, 0), max(top - seam_px, 0), right + seam_px, bottom + seam_px


def mask_inside(events: Events, box: Box) -> NDArray[np.bool_]:
    """Which events lie in a box, bool (n,)."""
    left, top, right, bottom = box
    found: NDArray[np.bool_] = (
        (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
    )
    return found


def boxes_overlap(a: Box, b: Box) -> bool:
    """Whether two boxes share a pixel."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def find_areas(
    hits: NDArray[np.int16], most: int, size_px: tuple[int, int], shift: int = CELL_SHIFT
) -> tuple[list[Box], int]:
    """Boxes around connected cells with hits, and how many were left out: those with the fewest hits.

    Args:
        hits: Hits by cell of 2^shift px, int16 (rows, columns).
        most: Most boxes to return.
        size_px: Columns and rows of the sensor.
        shift: See `hits`.
    """
    # Of 2 x 2 cells, one at the most begins an area.
    rows, columns = hits.shape
    room = ((rows + 1) // 2) * ((columns + 1) // 2)
    boxes, total = np.empty((room, 4), np.int64), np.empty(room, np.int64)
    count = _kernels.bound_areas(hits > 0, hits, boxes, total)
    boxes = boxes[:count]
    if count > most:
        boxes = boxes[np.sort(np.argsort(-total[:count], kind="stable")[:most])]
    return [tuple(box) for box in np.minimum(boxes << shift, size_px * 2).tolist()], max(count - most, 0)


def find_likeliest_row(
    rows: NDArray[np.int64], top: int, height: int, expected_px: float, stray_px: float, *, is_sized: bool
) -> float:
    """Find the middle row of a bar by the pixels in each row from `top` on, int64 (n,).

    Pixels in the bar's rows and in others are Poisson variables, half a pixel for none, which gives the
    log-likelihood of one more inside. Of a bar whose height may be wrong (not `is_sized`), only the places
    with the most pixels count, and of them the nearest one. `stray_px` is how far the bar usually is off.
    """
    # Of a few dozen places: lists are quicker than arrays.
    n, total = min(height, len(rows)), [0, *accumulate(rows.tolist())]
    inside = [below - above for above, below in zip(total[:-n], total[n:], strict=True)]
    most, beyond = max(inside), max(len(rows) - n, 1)
    other = (total[-1] - most) / beyond
    per_pixel = max(math.log((most / n + 0.5 / n) / (other + 0.5 / n)), 0.0) if is_sized else 0.0
    first_px = top + (n - 1) / 2
    places = [(pixels, at - (expected_px - first_px)) for at, pixels in enumerate(inside)]
    if per_pixel == 0:
        scores = [-abs(off) if pixels == most else -math.inf for pixels, off in places]
    else:
        scores = [per_pixel * pixels - (off / stray_px) * (off / stray_px) / 2 for pixels, off in places]
    return first_px + scores.index(max(scores))


def is_lit_again(
    rows: NDArray[np.int64], centre: float, height_px: float, lit_px: tuple[float, float]
) -> bool:
    """Whether rows of a bar that were dark in its newest frame hold half as many pixels as the lit ones."""
    edges = centre + np.array([-height_px / 2, *lit_px, height_px / 2])
    first, upper, lower, last = np.clip(np.round(edges).astype(int), 0, len(rows))
    hidden, lit = max(upper - first, 0) + max(last - lower, 0), lower - upper
    if hidden <= 0 or lit <= 0:
        return False
    inside = int(rows[upper:lower].sum())
    outside = int(rows[first:upper].sum()) + int(rows[lower:last].sum())
    return bool(outside * lit > _LIT_SHARE * inside * hidden)
