"""Finds a bar's layout in an image of presence: one similarity for all clusters, by votes."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import PresenceMap, replace_fields

_MIN_SPACING_PX = 1.0
"""A placement that puts neighbours into one pixel would fit anything."""

_MAX_CHANCE = 1e-3
"""Probability of so many clusters in their places by chance, above which it takes `min_share` of the
clusters, too: of a thousand frames at a wrong time one would pass, and a lock takes two preambles."""

_MAX_PROPOSERS = 64
"""Blobs that propose placements, the largest first: four for each of 16 clusters, a bar and its mirror image
among them. More would make the time grow with the square of the clutter."""

_MAX_INSTANCES = 4
"""Instances sought in one image: a bar, its mirror image on the road, one in a rail, and a neighbour."""

_OTHER_SHARE = 0.25
"""Least share of the best instance's cells that another one has: a pixel shows contrast, so that a mirror
image is as wide as the bar, while a lens' halo shows one cluster here and another there."""

_LINE_MARGIN_PX = 8
"""How far from a line's axis its light is sought, beyond a spacing: motion within a frame, and blur."""

_MIN_LIGHT = 0.25
"""Least light in step with its own pilot that a visible cluster's place has, in the median of the others'. In
recordings hidden clusters have up to 0.04, and the dimmest visible one, 180 m away or shaking, 0.58."""

_MIRRORED_FACTOR = 1.1
"""How much more a mirror image has to explain than the layout itself: of a single column or row in view both
explain the same but for rounding, of all else one hardly half of what the other does."""

_EDGE_SHARE = 0.5
"""Share of the likeliest distance from the axis below which cells are no longer the line's: its width at half
maximum. A lens' halo shows the clusters around, one here and another there, at up to a third."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A layout's clusters as complex numbers, right + down * 1j.

    Attributes:
        centres_m: Cluster centres, m, complex128 (K,).
        spacing_m: From one cluster to its nearest neighbour, m; 0 for a single cluster.
        is_line: The clusters stand in one line, which looks the same from behind.
        direction: From the first cluster to the last, of size 1; 1 for a single cluster.
    """

    centres_m: NDArray[np.complex128]
    spacing_m: float
    is_line: bool
    direction: complex


@dataclass(frozen=True, eq=False)
class Placement:
    """A layout's place in an image: image = scale * layout + shift, as complex numbers, right + down * 1j.

    Attributes:
        scale: Size and turn, px/m; 0 for a layout of one cluster, which has none.
        shift: Image of the layout's origin, px.
        mirrored: The image shows the layout's mirror image. A line of clusters is its own mirror image;
            there, the clusters run up the image, or left, as in a mirror on the road or upside down.
        seen: Clusters that stand in their place, bool (K,).
        cells: Grid cells that show a cluster in its place.
        chance: Upper bound of the probability of so many clusters in their places by chance.
        centres_px: Cluster centres in the image, px, complex128 (K,).
    """

    scale: complex
    shift: complex
    mirrored: bool
    seen: NDArray[np.bool_]
    cells: float
    chance: float
    centres_px: NDArray[np.complex128]


_Blobs = tuple[NDArray[np.complex128], NDArray[np.int64], NDArray[np.int64]]
"""Of connected cells of one cluster: centre in px, cluster, number of cells."""


def layout_of(centres_m: NDArray[np.float64]) -> Layout:
    """The layout with these cluster centres (x right, y down), m, float64 (K, 2).

    >>> layout_of(np.array([[0.0, -0.06], [0.0, 0.0], [0.0, 0.06]])).spacing_m
    0.06
    """
    centres = centres_m @ np.array([1, 1j])
    gaps = np.abs(centres[:, None] - centres[None])
    distances = gaps[gaps > 1e-9]
    span = complex(centres[-1] - centres[0])
    return Layout(
        centres,
        float(distances.min()) if len(distances) else 0.0,
        bool((np.ptp(centres_m, 0) < 1e-9).any()),
        span / abs(span) if span else 1 + 0j,
    )


def find_placements(
    presence: PresenceMap, layout: Layout, before: Placement | None = None, min_share: float = 0.5
) -> list[Placement]:
    """Find all instances of a layout in an image, best first: a bar, and its mirror images.

    Each pair of blobs of different clusters proposes a similarity, or, where the scale still holds `before`,
    in a frame shortly before, each blob a shift; the one with most cells in their place wins, nearer cells
    counting more. Blobs of neighbours, mirror images and strays propose in vain. Least squares over its blobs
    refine it; they are removed, and the rest votes again.

    Sixteen pilots of eight values are half of all that chance can show, so that a frame decoded at a wrong
    time shows clusters, too; but not in their order. One that is in its place without having proposed it is
    there with a chance of one in K. The best instance counts if its chance is small, or if `min_share` of the
    clusters are in their place: with few clusters any order is likely. All others need a small chance.
    """
    blobs: _Blobs = _kernels.find_blobs(presence.selected, presence.grid_px)
    clusters = len(layout.centres_m)
    at, _, many = blobs
    if not len(at):
        return []
    if clusters == 1:
        total = float(many.sum())
        shift = complex(many / total @ at)
        return [Placement(0j, shift, False, np.ones(1, np.bool_), total, 1.0, np.array([shift]))]
    slack_px = presence.grid_px / 2
    found: list[Placement] = []
    while len(found) < _MAX_INSTANCES:
        best, cells = None, 0
        if before is not None and not found:
            best, cells = _find_best(blobs, layout, slack_px, before)
        if best is None or best.chance > _MAX_CHANCE:
            voted, voted_cells = _find_best(blobs, layout, slack_px, None)
            if best is None or (voted is not None and voted.chance < best.chance):
                best, cells = voted, voted_cells
        if best is None:
            break
        if best.chance > _MAX_CHANCE and (found or best.seen.sum() < min_share * clusters):
            break
        if found and best.cells < _OTHER_SHARE * found[0].cells:
            break
        found.append(best)
        # Most images show one bar; the rest of them needs no vote.
        if cells < _OTHER_SHARE * found[0].cells:
            break
        # Blobs outside of the placement: neither in a cluster's place nor elsewhere in the bar.
        at, cluster, many = blobs
        reach_px = _cell_reach_px(best.scale, layout, slack_px)
        off = np.abs(at[:, None] - best.centres_px).min(1) > reach_px
        blobs = at[off], cluster[off], many[off]
    return found


def _cell_reach_px(scale: complex, layout: Layout, slack_px: float) -> float:
    return abs(scale) * layout.spacing_m / 2 + slack_px


def mask_presence(presence: PresenceMap, layout: Layout, placement: Placement) -> PresenceMap:
    """Mask presence by a layout's place: each cluster in its footprint, and nowhere else.

    Along the layout a cell shows the clusters whose shares of it are in it. Across a line, whose width is not
    in the layout, the cells of all clusters together show how likely a cell is so far from the axis. Beyond
    are a halo, neighbours and reflections. Pixel maps keep a spacing, to show where a cluster ends.
    """
    if placement.scale == 0:
        return presence
    unit = placement.scale / abs(placement.scale)
    if layout.is_line:
        unit *= layout.direction
    spacing_px = abs(placement.scale) * layout.spacing_m
    places = placement.centres_px
    given = presence.probability, presence.selected, presence.pixels
    # Most stays 0, and `zeros`, unlike `zeros_like`, does not write it.
    cells, dtype = given[0].shape, given[0].dtype
    prior, probability, selected = np.zeros(cells, dtype), np.zeros(cells, dtype), np.zeros(cells, np.bool_)
    pixels = np.zeros(given[2].shape, given[2].dtype)
    bins = math.ceil(spacing_px + _LINE_MARGIN_PX) if layout.is_line else 0
    place, out = (places, unit, spacing_px, presence.grid_px), (prior, probability, selected, pixels)
    _kernels.mask_presence(given, placement.seen, place, bins, _EDGE_SHARE, out)
    return PresenceMap(probability, presence.grid_px, selected, pixels, prior)


def drop_hidden_clusters(
    sums: NDArray[np.int16], edges: NDArray[np.int64], every: int, presence: PresenceMap, placement: Placement
) -> tuple[PresenceMap, Placement]:
    """Drop the clusters whose light is not in their place: behind a cover, or out of the image.

    Light of neighbours that blur brings into a hidden cluster's place follows their pilots, not its own.
    `sums` are those of the pilot, int16 (chips, height, width), `edges` those of the pilots, int64 (K, n),
    one `every` so many chips; `presence` is from `mask_presence`.
    """
    if presence.prior is None:
        return presence, placement
    light, seen = np.empty(len(edges)), np.empty(len(edges), np.bool_)
    place, least = (presence.prior, presence.grid_px, placement.seen), _MIN_LIGHT
    if not _kernels.measure_pilot_light(sums, edges, every, *place, least, (light, seen)):
        presence = drop_clusters(presence, ~seen)
    return presence, replace_fields(placement, seen=seen)


def drop_clusters(presence: PresenceMap, clusters: NDArray[np.bool_]) -> PresenceMap:
    """Presence without some clusters, bool (K,)."""
    images = {name: getattr(presence, name) for name in ("probability", "selected", "pixels", "prior")}
    kept = {name: image.copy() for name, image in images.items() if image is not None}
    for image in kept.values():
        image[clusters] = 0
    return replace_fields(presence, **kept)


def orient_centres(layout: Layout, mirrored: bool) -> NDArray[np.complex128]:
    """Cluster centres of a layout, or of its mirror image; of a line both are the same."""
    return np.conj(layout.centres_m) if mirrored and not layout.is_line else layout.centres_m


def _find_best(
    blobs: _Blobs, layout: Layout, slack_px: float, before: Placement | None
) -> tuple[Placement | None, int]:
    """The placement with most cells, and the cells in no place; None without blobs that could propose one."""
    best_score, best = 0.0, None
    orientations = (False,) if layout.is_line else (False, True)
    for mirrored in orientations if before is None or layout.is_line else (before.mirrored,):
        at_m = orient_centres(layout, mirrored)
        scale = 0j if before is None else before.scale
        place, proposers = (at_m, layout.spacing_m, slack_px), min(len(blobs[0]), _MAX_PROPOSERS)
        score, s, shift = _kernels.find_similarity(blobs, proposers, *place, _MIN_SPACING_PX, scale)
        if score > 0:
            s, shift = _kernels.refine_similarity(blobs, *place, scale, s, shift)
        if score > best_score * (_MIRRORED_FACTOR if mirrored else 1):
            best_score, best = score, (s, shift, mirrored)
    if best is None:
        return None, 0
    scale, shift, mirrored = best
    places = scale * orient_centres(layout, mirrored) + shift
    spacing_px, reach_px = abs(scale) * layout.spacing_m, _cell_reach_px(scale, layout, slack_px)
    seen = np.empty(len(places), np.bool_)
    shown, hits, cells, left = _kernels.assign_cells(*blobs, places, reach_px, spacing_px / 2, seen)
    # Where clusters are small, a cell stands in the place of two.
    p_hit = min(1.0, (2 * reach_px / spacing_px) ** (1 if layout.is_line else 2) / len(places))
    # As many similarities could have been proposed as there are choices of the clusters that fix one.
    proposed = 1 if before is not None else 2
    tries = math.comb(max(shown, proposed), proposed)
    chance = min(1.0, tries * _binomial_tail(hits - proposed, shown - proposed, p_hit))
    if layout.is_line:
        direction = scale * layout.direction
        mirrored = direction.real + direction.imag < 0
    return Placement(scale, shift, mirrored, seen, cells, chance, places), left


def _binomial_tail(hits: int, trials: int, p_hit: float) -> float:
    if hits <= 0:
        return 1.0
    return float(
        sum(math.comb(trials, n) * p_hit**n * (1 - p_hit) ** (trials - n) for n in range(hits, trials + 1))
    )
