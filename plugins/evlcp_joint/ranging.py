"""Distance from all boundaries between neighbouring clusters at once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_joint import _kernels
from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import ROLES, Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import NO_RANGE, Curvature, FrameView, Range, replace_fields, to_kernel_array

_START_GAIN = 0.8
"""Share of a full value that a cluster's rows show, with a fifth of the negative events missing."""

_TAIL_WIDTH = 3.0
"""Width of the tails of a boundary's profile, in cores: the log of the light's ratio, clipped at a full
value, is steep in the middle, and the lens gives it tails."""

_CORE_SHARE = 0.4
"""Share of the core in a boundary's profile; tails have the rest."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class JointScaleRanging(Ranging):
    """Least-squares fit of spacing, position, drift, gain and blur to the values of all rows, pilot and info.

    A pixel across a boundary sees light of both clusters, shares f and 1 - f. Where their codes differ, its
    log signal moves by ln(f / (1 - f)) at the edge in a value's middle, and so the sum of its events crosses
    zero at the boundary with a slope: that gives the place of the boundary to a fraction of a pixel. All rows
    and values are fitted by one straight scale. Rows beyond the middles of the outermost clusters, where
    there is no neighbour, are left out, so that an outer edge cannot bias it. The rest of the motion within
    the frame is known from the track, its rate is fitted, and the rest is found value by value.

    Positive and negative events are not alike in number and time, and an edge leaves late events and blind
    pixels to the next one a chip later. Both shift boundaries, by up to a twentieth of a pixel: those that
    step up to one side and those that step down to the other, and into the cluster that repeats a value. As
    pilots are the same in every frame, scale and curvature would be off; so both are fitted, too.

    Cells out of line with the layout, boundaries out of line with the others, and info values of clusters
    whose symbol is not known are left out. There is no distance if the fit leaves the cells or explains too
    little.

    The pilots have to be pair codes. In a frame with other codewords, only the pilot is used.

    For a layout of several even columns, each gives a distance, and these are averaged by their boundaries;
    where they differ by more than their sigmas, sigma grows as much. From side to side nothing is measured: a
    panel that is turned away looks narrower, but not lower.

    Sigma is the mean of two estimates, which see different errors: one takes each row as an observation
    (sandwich estimator), as a row's values share one pixel phase; the other is the scatter of the boundaries.
    """

    blur_px: Annotated[
        float,
        Field(gt=0, le=5, description="Width (sigma) of a boundary's core in the image: lens and pixel."),
    ] = 0.2
    min_boundaries: Annotated[
        int,
        Field(
            ge=2,
            description="Boundaries with both clusters seen that a distance needs, or all of a smaller bar.",
        ),
    ] = 6

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Precompute for a bar of one column or more.

        Raises:
            ConfigError: The layout has no even column of three clusters or more, or pilots are no pair codes.
        """
        if not bar.even_columns:
            raise ConfigError(
                "ranging 'joint-scale' needs an even column of three clusters or more; "
                + _suggest_ranging(bar, codebook)
            )
        codebook.require_pairs("ranging", "joint-scale", "poc", codes=("pilots",))
        measures = [self._compile_column(camera, codebook, *column) for column in bar.even_columns]
        if len(measures) == 1 and len(bar.even_columns[0][0]) == bar.clusters:
            return measures[0]
        columns = [ids for ids, _ in bar.even_columns]

        def measure(view: FrameView) -> Range:
            parts = [one(_select_column(view, ids)) for one, ids in zip(measures, columns, strict=True)]
            return _average_columns([part for part in parts if part.sigma_m > 0])

        return measure

    def _compile_column(
        self, camera: CameraModel, codebook: Codebook, column: NDArray[np.int64], spacing_m: float
    ) -> Measure:
        clusters, least = len(column), min(self.min_boundaries, len(column) - 1)
        pilots = codebook.pilot_values[column].astype(np.float64)
        words = codebook.codeword_values.astype(np.float64)
        boundaries = np.arange(1.0, clusters) - clusters / 2
        n = pilots.shape[1] + words.shape[1]
        chips, late_chips = 2 * n, float(words.shape[1])

        def measure(view: FrameView) -> Range:
            found = find_bar(view, chips)
            if found is None:
                return NO_RANGE
            sums, offset_px, line, seen = found
            height, (first, spacing, _, tilt, _) = sums.shape[1], line.tolist()
            values = np.empty((n, height))
            _kernels.read_rows(sums, line, clusters, values)
            lens = self.blur_px, _kernels.measure_polarity_ratio(sums, pilots, seen, line)
            if spacing < 0:
                # A bar upside down is mirrored.
                spacing, first = -spacing, height - 1 - first
                values, offset_px = to_kernel_array(values[:, ::-1]), -offset_px
            decoded = pilots, words, to_kernel_array(view.soft.symbols), seen
            centre = first + spacing * (clusters - 1) / 2 - (height - 1) / 2
            fit = np.array([spacing, centre, 0.0, _START_GAIN, 0.0, 0.0, 0.0])
            (variance, seen_boundaries, wider_px), by_boundary = _kernels.fit_bar(
                decoded, offset_px, values, boundary_profile(_CORE_SHARE), lens, least, fit
            )
            spacing_px, centre_px, *_ = fit.tolist()
            # From the start, by cells, an end moves by the size of a cell and a pixel of blur at most.
            farthest = abs(spacing_px - spacing) * (clusters - 1) / 2 + abs(centre_px - centre)
            if math.isnan(variance) or farthest > view.presence.grid_px + 1:
                return NO_RANGE
            # Rows measure the bar along one axis; a tilted bar is longer by its slope.
            stretch = math.hypot(1.0, tilt)
            distance = camera.distance_m(spacing_m, spacing_px * stretch)
            unit_px = spacing_m * spacing_px * stretch / distance
            off, weight, phase_bias = by_boundary[:, 1:-1]
            return Range(
                distance,
                distance * math.sqrt(variance) / spacing_px,
                seen_boundaries,
                late_chips,
                Curvature(
                    boundaries.copy(),
                    off / unit_px,
                    weight * unit_px**2,
                    phase_bias / unit_px,
                    -distance * wider_px / spacing_px,
                    spacing_px,
                    unit_px,
                ),
            )

        return measure


def find_bar(
    view: FrameView, chips: int
) -> tuple[NDArray[np.int16], Floats, Floats, NDArray[np.bool_]] | None:
    """Find a bar in the cells of a frame; None with fewer than three clusters, or all in one place.

    Its line is that of least squares through all cells.

    Returns:
        Sums of the first `chips` chips and the offset of the bar along itself in each, turned so that it lies
        along the rows; its line, float64 (5,), as for `_kernels.read_rows`; and which clusters are seen.
    """
    selected, grid, sums, offset_px = view.presence.selected, view.presence.grid_px, view.sums, view.offset_px
    cluster, row, column = np.unravel_index(np.flatnonzero(selected), selected.shape)
    seen = np.bincount(cluster, minlength=len(selected)) > 0
    if np.count_nonzero(seen) < 3:
        return None
    cells = np.array((cluster, row, column), np.float64)
    mean = np.add.reduce(cells, 1) / len(row)
    off = cells - mean[:, None]
    moments, centre = (off @ off.T / len(row)).tolist(), mean.tolist()
    along, across = (1, 2) if moments[1][1] >= moments[2][2] else (2, 1)
    if moments[along][along] == 0:
        return None
    if along == 2:
        sums, offset_px = sums.swapaxes(1, 2), offset_px[::-1]
    spacing, tilt = moments[0][along] / moments[0][0], moments[1][2] / moments[along][along]
    # Of n cells in a row the variance is (n^2 - 1) / 12.
    wide = math.sqrt(12 * (moments[across][across] - tilt * moments[1][2]) + 1)
    if abs(tilt) * math.sqrt(12 * moments[along][along]) * grid < 1:
        # Upright to a pixel: all rows are read from the same columns.
        tilt = 0.0
    first, left = centre[along] - spacing * centre[0], centre[across] - tilt * centre[along]
    # In pixels, where a cell's number is that of its middle.
    middle = (grid - 1) / 2
    line = [first * grid + middle, spacing * grid, left * grid + middle * (1 - tilt), tilt, wide * grid / 2]
    return to_kernel_array(sums[:chips]), to_kernel_array(offset_px[1, :chips]), np.array(line), seen


@cache
def boundary_profile(core_share: float) -> Floats:
    """Profile of a boundary with a core of width 1: -1 to 1 across it, and its slope, float64 (2, n).

    From its middle to `_kernels.PROFILE_REACH`; linear interpolation is off by a hundred-thousandth.
    """
    # As SciPy's to the last bits, without the import.
    erf = np.vectorize(math.erf)
    z = np.linspace(0, _kernels.PROFILE_REACH, 2049)
    parts = ((core_share, 1.0), (1 - core_share, _TAIL_WIDTH))
    across = sum(share * erf(z / wide / np.sqrt(2)) for share, wide in parts)
    slope = sum(share * 2 * np.exp(-0.5 * (z / wide) ** 2) / wide for share, wide in parts) / np.sqrt(
        2 * np.pi
    )
    return np.stack([across, slope])


def _select_column(view: FrameView, clusters: NDArray[np.int64]) -> FrameView:
    presence, soft = view.presence, view.soft
    return replace_fields(
        view,
        presence=replace_fields(presence, selected=presence.selected[clusters]),
        soft=replace_fields(soft, symbols=soft.symbols[clusters]),
    )


def _average_columns(parts: Sequence[Range]) -> Range:
    """The mean of columns' distances by their boundaries; sigma grows by as much as they differ.

    The information of n even boundaries grows with the cube of n. A column's own sigma, from the scatter of a
    few, is too uncertain for a weight; all of them together give the sigma of a boundary.
    """
    if not parts:
        return NO_RANGE
    distance, sigma, pairs = np.array([(part.distance_m, part.sigma_m, part.pairs) for part in parts]).T
    share = pairs**3
    weight = share / np.mean(sigma**2 * share)
    mean = float(weight @ distance / weight.sum())
    spread = float(weight @ (distance - mean) ** 2) / max(len(parts) - 1, 1)
    sigma_m = math.sqrt(max(spread, 1.0) / float(weight.sum()))
    return Range(mean, sigma_m, int(pairs.sum()), parts[0].late_chips)


def _suggest_ranging(bar: BarLayout, codebook: Codebook) -> str:
    if bar.clusters < 2:
        return "no ranging measures the distance of one cluster: use 'none' for this layout"
    return ROLES["ranging"].suggest_for(bar, codebook.unpaired_codes)
