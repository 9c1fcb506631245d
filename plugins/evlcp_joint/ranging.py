"""Distance from all boundaries between neighbouring clusters at once."""

from dataclasses import dataclass
from functools import cache
from statistics import median
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import FrameView, PresenceMap, Range

__all__ = ["JointScaleRanging"]

_NONE = Range(float("nan"), float("nan"), 0)

_STEPS = 12
"""Newton steps at the most; from a start within a tenth of a spacing, four suffice."""

_STARTING_GAIN = 0.8
"""Share of a full value that a cluster's rows show, with a fifth of the negative events missing."""


@dataclass(frozen=True)
class JointScaleRanging(Ranging):
    """Least-squares fit of spacing, position, drift and gain to the values of all rows, pilot and info.

    A pixel across a boundary sees light of both clusters, shares f and 1 - f. Where their codes differ, its
    log signal moves by ln(f / (1 - f)) at the edge in a value's middle, and so the sum of its events crosses
    zero at the boundary with a slope: that says where the boundary lies, to a fraction of a pixel. All rows
    and values are fitted by one straight scale. Rows beyond the middles of the outermost clusters, where
    there is no neighbour, are left out, so that an outer edge cannot bias it. What remains of the
    motion within the frame is known from the track, and its rate is fitted.

    Sigma takes each row as one observation (sandwich estimator), as a row's values share one pixel phase.
    """

    blur_px: Annotated[
        float, Field(gt=0, le=5, description="Width (sigma) of a boundary in the image: lens and pixel.")
    ] = 0.45
    full_events: Annotated[
        float, Field(gt=0, description="Events of a pixel in a chip that count as a full value.")
    ] = 3.0
    huber: Annotated[
        float, Field(gt=0, description="Residual, in full values, beyond which a row weighs less.")
    ] = 0.5
    min_boundaries: Annotated[
        int,
        Field(
            ge=2,
            description="Boundaries with both clusters seen that a distance needs, or all of a smaller bar.",
        ),
    ] = 6

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Precompute for a bar of one column.

        Raises:
            ConfigError: The layout has more than one column of clusters, or fewer than three.
        """
        centres = bar.cluster_centres_m()
        if np.ptp(centres[:, 0]) > 1e-9 or len(centres) < 3:
            raise ConfigError(
                "ranging 'joint-scale' needs one column of three clusters or more; " + _instead(len(centres))
            )
        least = min(self.min_boundaries, len(centres) - 1)
        spacing_m = float(centres[1, 1] - centres[0, 1])
        pilots, words = codebook.pilots.astype(np.int64), codebook.codewords.astype(np.int64)

        def measure(view: FrameView) -> Range:
            codes = np.concatenate([pilots, words[view.soft.symbols]], axis=1)
            place = _place(view.presence)
            if place is None:
                return _NONE
            rows, columns, seen, half_width = place
            if int((seen[1:] & seen[:-1]).sum()) < least:
                return _NONE
            sums, offset = view.sums, view.offset_px[:, 0::2] / 2 + view.offset_px[:, 1::2] / 2
            if np.ptp(columns[seen]) > np.ptp(rows[seen]):
                # A bar that lies across the image: exchange rows and columns.
                sums, rows, columns = sums.transpose(0, 2, 1), columns, rows
                offset = offset[::-1]
            height = sums.shape[1]
            k = np.flatnonzero(seen)
            spacing, first = _straight(k, rows[k])
            tilt, left = _straight(rows[k], columns[k])
            # The columns of a value move with the bar; a row's centre follows from its line at rest.
            line = np.array([left, tilt])
            values = np.empty((codes.shape[1], height))
            from evlcp_joint import _kernels

            _kernels.row_values(sums, line, half_width, self.full_events, values)
            if spacing < 0:
                # A bar upside down: mirror it.
                values, offset, spacing = np.ascontiguousarray(values[:, ::-1]), -offset, -spacing
                first = height - 1 - first
            centre = first + spacing * (len(codes) - 1) / 2 - (height - 1) / 2
            fit = np.array([spacing, centre, 0.0, _STARTING_GAIN])
            fitted = self._fit(codes, seen, np.ascontiguousarray(offset[1]), values, fit)
            if fitted is None:
                return _NONE
            fit, sigma_px = fitted
            # Rows measure the bar along one axis; a tilted bar is longer by its slope.
            stretch = float(np.hypot(1.0, tilt))
            distance = camera.distance_m(spacing_m, float(fit[0]) * stretch)
            return Range(distance, distance * sigma_px / float(fit[0]), int((seen[1:] & seen[:-1]).sum()))

        return measure

    def _fit(
        self,
        codes: NDArray[np.int64],
        seen: NDArray[np.bool_],
        offset: NDArray[np.float64],
        values: NDArray[np.float64],
        fit: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], float] | None:
        """Levenberg-Marquardt; the fit and the standard deviation of its spacing, px."""
        from evlcp_joint import _kernels

        when = np.arange(values.shape[0]) / values.shape[0] - 0.5
        value, slope = np.empty(values.shape), np.empty((4, *values.shape))
        normal, right = np.empty((4, 4)), np.empty(4)

        def cost_of(at: NDArray[np.float64]) -> float:
            _kernels.model(codes, seen, offset, when, self.blur_px, at, value, slope)
            return float(_kernels.step_of(values, value, slope, self.huber, normal, right))

        cost, damping = cost_of(fit), 1e-3
        for _ in range(_STEPS):
            here = normal.copy(), right.copy()
            try:
                move = np.linalg.solve(here[0] + damping * np.diag(np.diag(here[0])), here[1])
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(move).all() or fit[0] + move[0] < 1:
                return None
            new_cost = cost_of(fit + move)
            if new_cost <= cost:
                fit, damping = fit + move, damping / 10
                done = abs(move[0]) < 1e-5 * fit[0]
                cost = new_cost
                if done:
                    break
            else:
                damping *= 10
                cost_of(fit)
        # Value, slope and normal equations are those of `fit`, whether its last move was taken or not.
        meat = np.empty((4, 4))
        rows = _kernels.row_scores(values, value, slope, self.huber, meat)
        try:
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return None
        variance = (inverse @ meat @ inverse)[0, 0] * rows / max(rows - 4, 1)
        return fit, float(np.sqrt(max(variance, 0.0)))


def _instead(clusters: int) -> str:
    """The ranging for a layout that this one refuses, if any is."""
    if clusters < 2:
        return "no ranging measures the distance of one cluster"
    # Of few clusters, `poc` must not leave out the outermost.
    return "use 'poc' for this layout" + (", with ranging.skip_outer = 0" if clusters < 4 else "")


def _place(
    presence: PresenceMap,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], float] | None:
    """Rows and columns of the clusters' middles, which are seen, and half the bar's width, px."""
    selected = presence.selected
    # Products with ones are several times as fast as sums of booleans, and as exact.
    cells = selected.astype(np.float32)
    in_row = cells @ np.ones(cells.shape[2], np.float32)
    in_column = np.ones(cells.shape[1], np.float32) @ cells
    area = in_row.sum(1)
    seen = area > 0
    if seen.sum() < 3:
        return None
    grid = presence.grid_px
    count = np.maximum(area, 1)
    middle = (grid - 1) / 2
    rows = in_row @ np.arange(selected.shape[1]) / count * grid + middle
    columns = in_column @ np.arange(selected.shape[2]) / count * grid + middle
    across = selected.any(0).sum(0) if np.ptp(rows[seen]) >= np.ptp(columns[seen]) else selected.any(0).sum(1)
    # Cells of the bar's core; stray ones beside it are seen in few rows only.
    width = grid * int((across >= 0.3 * across.max()).sum())
    return rows, columns, seen, width / 2


def _straight(x: NDArray[np.float64] | NDArray[np.int64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Slope and intercept of the line through the medians (Theil-Sen), robust against outliers."""
    i, j = _pairs(len(x))
    apart = x[j] - x[i]
    far = np.abs(apart) > 1e-9
    slope = median(((y[j] - y[i])[far] / apart[far]).tolist())
    return slope, median((y - slope * x).tolist())


@cache
def _pairs(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Both of every pair of n."""
    first, second = np.triu_indices(n, 1)
    return first, second
