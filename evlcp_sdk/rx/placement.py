"""Where a bar's layout lies in an image of presence: one similarity for all clusters, found by votes."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import PresenceMap, replace_fields

_LEAST_SPACING_PX = 1.0
"""A placement that puts neighbours into one pixel would fit anything."""

_MAX_CHANCE = 1e-3
"""Probability that clusters stand in their place by chance, above which they are not believed without more:
of a thousand frames read at a wrong time, one would pass, and a lock needs two preambles at the right
distance before."""

_PROPOSERS = 64
"""Blobs that propose placements, the largest first: four for each of 16 clusters, a bar and its mirror image
among them. More would make the time grow with the square of the clutter."""

_MOST = 4
"""Instances sought in one image: a bar, its mirror image on the road, one in a rail, and a neighbour."""

_OTHER_CELLS = 0.25
"""Share of the best instance's cells that another one has at the least: a pixel shows contrast, so that a
mirror image is as wide as the bar, while a lens' halo shows one cluster here and another there."""

_WIDEST_PX = 8
"""How far from a line's axis its light is sought, beyond a spacing: motion within a frame, and blur."""

_LEAST_LIGHT = 0.25
"""Light in step with its own pilot that a cluster's place shows at the least, in that of the others' median.
In recordings hidden clusters have up to 0.04, and the dimmest that is seen, 180 m away or in a shaking
camera, 0.58."""

_MIRRORED = 1.1
"""How much more a mirror image explains than the layout itself: of a single column or row in view both
explain as much but for rounding, of all else one hardly half of what the other does."""

_EDGE = 0.5
"""Share of the likeliest distance from the axis below which cells are no longer the line's: its width at half
maximum. A lens' halo shows the clusters around, one here and another there, at up to a third."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A layout's clusters as complex numbers, right + down * 1j.

    Attributes:
        at_m: Cluster centres, m, complex128 (K,).
        spacing_m: From one cluster to its nearest neighbour, m; 0 for a single cluster.
        line: Whether the clusters stand in one line, which looks the same from behind.
        way: Direction from the first cluster to the last, of size 1; 1 for a single cluster.
    """

    at_m: NDArray[np.complex128]
    spacing_m: float
    line: bool
    way: complex


@dataclass(frozen=True, eq=False)
class Placement:
    """A layout's place in an image: image = scale * layout + shift, as complex numbers, right + down * 1j.

    Attributes:
        scale: Size and turn, px/m; 0 for a layout of one cluster, which has none.
        shift: Image of the layout's origin, px.
        mirrored: The layout's mirror image lies so. A line of clusters is its own mirror image; there, the
            order of the clusters runs up the image, or to the left: in a mirror on the road, and in a camera
            upside down.
        seen: Clusters that stand in their place, bool (K,).
        cells: Grid cells that show a cluster in its place.
        chance: Bound of the probability that chance puts so many clusters into their places.
    """

    scale: complex
    shift: complex
    mirrored: bool
    seen: NDArray[np.bool_]
    cells: float
    chance: float

    def places(self, layout: Layout) -> NDArray[np.complex128]:
        """Cluster centres in the image, px, complex128 (K,); not to be changed."""
        # Asked for again and again in a frame.
        known: tuple[Layout, NDArray[np.complex128]] | None = vars(self).get("_places")
        if known is None or known[0] is not layout:
            known = layout, self.scale * turned(layout, self.mirrored) + self.shift
            vars(self)["_places"] = known
        return known[1]


_Blobs = tuple[NDArray[np.complex128], NDArray[np.int64], NDArray[np.int64]]
"""Of connected cells of one cluster: centre in px, cluster, number of cells."""


def layout_of(centres_m: NDArray[np.float64]) -> Layout:
    """A layout by its cluster centres (x right, y down), m, float64 (K, 2).

    >>> layout_of(np.array([[0.0, -0.06], [0.0, 0.0], [0.0, 0.06]])).spacing_m
    0.06
    """
    at = centres_m @ np.array([1, 1j])
    gaps = np.abs(at[:, None] - at[None])
    apart = gaps[gaps > 1e-9]
    way = complex(at[-1] - at[0])
    return Layout(
        at,
        float(apart.min()) if len(apart) else 0.0,
        bool((np.ptp(centres_m, 0) < 1e-9).any()),
        way / abs(way) if way else 1 + 0j,
    )


def placements(
    presence: PresenceMap, layout: Layout, before: Placement | None = None, min_share: float = 0.5
) -> list[Placement]:
    """Find where a layout lies in an image, best first; several in one image: a bar, and its mirror image.

    Each pair of blobs of different clusters proposes a similarity, or, where the scale is known from a frame
    before, each blob a shift; the one that has most cells in their place counts, those nearer to it more.
    Blobs of neighbours, mirror images and strays propose in vain. Least squares over its blobs make it exact;
    they are taken away, and the rest votes again.

    Sixteen pilots of eight values are half of what chance can say, so that a frame read at a wrong time shows
    clusters, too; but not in their order. One that is in its place without having proposed it is there with a
    chance of one in K. The best counts if that is unlikely, or if `min_share` of the clusters are in their
    place: with few clusters no order is unlikely. All others count if they are unlikely.

    Args:
        presence: Of one frame.
        layout: What to find.
        before: In a frame shortly before: its scale still holds.
        min_share: Least share of the clusters in place that counts without a doubt.
    """
    blobs: _Blobs = _kernels.find_blobs(presence.selected, presence.grid_px)
    clusters = len(layout.at_m)
    at, _, many = blobs
    if not len(at):
        return []
    if clusters == 1:
        total = float(many.sum())
        return [Placement(0j, complex(many / total @ at), False, np.ones(1, np.bool_), total, 1.0)]
    slack_px = presence.grid_px / 2
    found: list[Placement] = []
    while len(found) < _MOST:
        best, cells = None, 0
        if before is not None and not found:
            best, cells = _voted(blobs, layout, slack_px, before)
        if best is None or best.chance > _MAX_CHANCE:
            other, its = _voted(blobs, layout, slack_px, None)
            if best is None or (other is not None and other.chance < best.chance):
                best, cells = other, its
        if best is None:
            break
        if best.chance > _MAX_CHANCE and (found or best.seen.sum() < min_share * clusters):
            break
        if found and best.cells < _OTHER_CELLS * found[0].cells:
            break
        found.append(best)
        # Most images show one bar; what is left of them needs no vote.
        if cells < _OTHER_CELLS * found[0].cells:
            break
        # What a placement has not used up, neither in its clusters' places nor elsewhere in the bar.
        at, cluster, many = blobs
        off = np.abs(at[:, None] - best.places(layout)).min(1) > _reach(best.scale, layout, slack_px)
        blobs = at[off], cluster[off], many[off]
    return found


def _reach(scale: complex, layout: Layout, slack_px: float) -> float:
    """How far around a cluster's place its cells are."""
    return abs(scale) * layout.spacing_m / 2 + slack_px


def masked(presence: PresenceMap, layout: Layout, placement: Placement) -> PresenceMap:
    """Presence, the layout's place taken in: each cluster in its footprint, and nowhere else.

    Along the layout a cell shows the clusters whose shares of it are in it. Across a line, whose width the
    layout does not say, the cells of all clusters together show how likely a cell is so far from the axis.
    Beyond are a halo, neighbours and reflections. Pixel maps keep a spacing, so that they still show where a
    cluster ends.
    """
    if placement.scale == 0:
        return presence
    unit = placement.scale / abs(placement.scale)
    if layout.line:
        unit *= layout.way
    spacing_px = abs(placement.scale) * layout.spacing_m
    places = placement.places(layout)
    given = presence.probability, presence.selected, presence.pixels
    # Most of them stays 0, and is not written, as `zeros_like` does.
    cells, dtype = given[0].shape, given[0].dtype
    prior, probability, selected = np.zeros(cells, dtype), np.zeros(cells, dtype), np.zeros(cells, np.bool_)
    pixels = np.zeros(given[2].shape, given[2].dtype)
    bins = math.ceil(spacing_px + _WIDEST_PX) if layout.line else 0
    place, out = (places, unit, spacing_px, presence.grid_px), (prior, probability, selected, pixels)
    _kernels.mask_presence(given, placement.seen, place, bins, _EDGE, out)
    return PresenceMap(probability, presence.grid_px, selected, pixels, prior)


def lit(
    sums: NDArray[np.int16],
    edges: NDArray[np.int64],
    every: int,
    presence: PresenceMap,
    placement: Placement,
) -> tuple[PresenceMap, Placement]:
    """Leave out the clusters whose light is not in their place: behind a cover, or out of the image.

    Light of neighbours that blur brings into a hidden cluster's place follows their pilots, not its own.

    Args:
        sums: Polarity sums of the pilot, int16 (chips, height, width).
        edges: Those of the pilots, int64 (K, n).
        every: Chips from one of them to the next.
        presence: As from `masked`.
        placement: Of the same image.
    """
    if presence.prior is None:
        return presence, placement
    light, seen = np.empty(len(edges)), np.empty(len(edges), np.bool_)
    place, least = (presence.prior, presence.grid_px, placement.seen), _LEAST_LIGHT
    if not _kernels.measure_pilot_light(sums, edges, every, *place, least, (light, seen)):
        presence = without(presence, ~seen)
    return presence, replace_fields(placement, seen=seen)


def without(presence: PresenceMap, clusters: NDArray[np.bool_]) -> PresenceMap:
    """Presence of the other clusters alone."""
    images = {name: getattr(presence, name) for name in ("probability", "selected", "pixels", "prior")}
    kept = {name: image.copy() for name, image in images.items() if image is not None}
    for image in kept.values():
        image[clusters] = 0
    return replace_fields(presence, **kept)


def turned(layout: Layout, mirrored: bool) -> NDArray[np.complex128]:
    """Cluster centres of a layout, or of its mirror image; of a line both are one and the same."""
    return np.conj(layout.at_m) if mirrored and not layout.line else layout.at_m


def _voted(
    blobs: _Blobs, layout: Layout, slack_px: float, before: Placement | None
) -> tuple[Placement | None, int]:
    """The placement that most cells are for, None without blobs that could propose one; the cells beside."""
    best_score, best = 0.0, None
    ways = (False,) if layout.line else (False, True)
    for mirrored in ways if before is None or layout.line else (before.mirrored,):
        at_m = turned(layout, mirrored)
        scale = 0j if before is None else before.scale
        place, proposers = (at_m, layout.spacing_m, slack_px), min(len(blobs[0]), _PROPOSERS)
        score, s, shift = _kernels.find_similarity(blobs, proposers, *place, _LEAST_SPACING_PX, scale)
        if score > 0:
            s, shift = _kernels.refine_similarity(blobs, *place, scale, s, shift)
        if score > best_score * (_MIRRORED if mirrored else 1):
            best_score, best = score, (s, shift, mirrored)
    if best is None:
        return None, 0
    s, shift, mirrored = best
    return _judged(blobs, layout, slack_px, s, shift, mirrored, 1 if before is not None else 2)


def _judged(
    blobs: _Blobs,
    layout: Layout,
    slack_px: float,
    scale: complex,
    shift: complex,
    mirrored: bool,
    proposed: int,
) -> tuple[Placement, int]:
    """A similarity with what is in its place, and how likely that is by chance; the cells in no place."""
    clusters = len(layout.at_m)
    places = scale * turned(layout, mirrored) + shift
    spacing_px, reach = abs(scale) * layout.spacing_m, _reach(scale, layout, slack_px)
    seen = np.empty(clusters, np.bool_)
    shown, many, cells, left = _kernels.assign_cells(*blobs, places, reach, spacing_px / 2, seen)
    # Where clusters are small, a cell stands in the place of two.
    odds = min(1.0, (2 * reach / spacing_px) ** (1 if layout.line else 2) / clusters)
    # As many similarities could have been proposed as there are choices of the clusters that fix one.
    tries = math.comb(max(shown, proposed), proposed)
    chance = min(1.0, tries * _at_least(many - proposed, shown - proposed, odds))
    if layout.line:
        way = scale * layout.way
        mirrored = way.real + way.imag < 0
    placement = Placement(scale, shift, mirrored, seen, cells, chance)
    vars(placement)["_places"] = layout, places
    return placement, left


def _at_least(hits: int, of: int, odds: float) -> float:
    """Probability of so many hits or more (binomial)."""
    if hits <= 0:
        return 1.0
    return float(sum(math.comb(of, n) * odds**n * (1 - odds) ** (of - n) for n in range(hits, of + 1)))
