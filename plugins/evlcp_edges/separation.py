"""Separation of clusters by the edges of pilots of any chips."""

from dataclasses import dataclass
from math import log
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.lazy import LazyModule
from evlcp_sdk.plugin.roles import Separate, Separation
from evlcp_sdk.values import PresenceMap

if TYPE_CHECKING:
    from scipy import ndimage
else:
    ndimage = LazyModule("scipy.ndimage")


@dataclass(frozen=True)
class EdgeSeparation(Separation):
    """Agreement of each grid cell's signs with every pilot's edges, as a probability by Bayes' rule.

    In each chip of the pilot a cell brightens, darkens, or stays as it is. Where a pilot has an edge, a cell
    that shows its cluster follows the edge, but for errors; where it has none, light of neighbours and late
    events come with either sign (in nine cells of ten, at 50 m), as they do in a cell that shows no cluster.
    A cell that stays as it is carries no information. All clusters, and none, are equally likely before.
    """

    grid_px: Annotated[int, Field(ge=2, le=16, description="Side of a grid cell.")] = 2
    edge_error: Annotated[
        float, Field(gt=0, lt=0.5, description="Probability that a cell's answer to an edge is seen wrong.")
    ] = 0.1
    min_answers: Annotated[
        int, Field(ge=1, description="Chips in which a cell answers at the least to show a cluster.")
    ] = 4
    min_probability: Annotated[
        float, Field(gt=0, lt=1, description="Presence probability that selects a cell.")
    ] = 0.5

    def compile(self, codebook: Codebook) -> Separate:
        """Precompute for a codebook's pilots.

        Raises:
            ConfigError: It has none, or of one chip.
        """
        chips = codebook.pilots.astype(np.int64)
        if chips.shape[1] < 2:
            raise ConfigError(f"separation 'edges': pilots of {chips.shape[1]} chips have no edges")
        edges = np.diff(chips, axis=1)
        agree, disagree = log((1 - self.edge_error) / 0.5), log(self.edge_error / 0.5)
        # Log-likelihood ratio of an answer to an edge is this much more than half of it if they agree.
        half, apart = (agree + disagree) / 2, (agree - disagree) / 2
        norm = np.maximum(np.abs(edges).sum(1), 1)
        edges32 = edges.astype(np.float32)

        def separate(sums: NDArray[np.int16]) -> PresenceMap:
            _, height, width = sums.shape
            answers = np.sign(cell_sums(sums[1:], self.grid_px)).astype(np.int8)
            n, rows, columns = answers.shape
            seen = np.abs(answers).sum(0, dtype=np.int64)
            flat = answers.reshape(n, -1).astype(np.float64)
            fits = apart * (edges @ flat) + half * (np.abs(edges) @ np.abs(flat))
            odds = np.exp(fits)
            # Without a cluster signs are random; its prior is that of all clusters together.
            probability = odds / (len(chips) + odds.sum(0))
            probability = probability.reshape(len(chips), rows, columns).astype(np.float32)
            probability[:, seen < self.min_answers] = 0
            selected = probability >= self.min_probability
            # Sums of ones are exact in float32, and floats are multiplied by BLAS.
            fit = edges32 @ np.sign(sums[1:]).astype(np.float32).reshape(n, -1)
            pixels = fit.reshape(-1, height, width).astype(np.float64) / norm[:, None, None]
            near = ndimage.binary_dilation(selected, np.ones((1, 3, 3), np.bool_))
            pixels = np.where(to_pixels(near, self.grid_px, height, width), np.maximum(pixels, 0), 0)
            return PresenceMap(probability, self.grid_px, selected, pixels.astype(np.float32))

        return separate


def cell_sums(image: NDArray[np.int16], grid: int) -> NDArray[np.int64]:
    """Sums over whole cells, (..., height, width) -> int64 (..., rows, columns)."""
    *others, height, width = image.shape
    rows, columns = height // grid, width // grid
    whole = image[..., : rows * grid, : columns * grid].astype(np.int64)
    found: NDArray[np.int64] = whole.reshape(*others, rows, grid, columns, grid).sum((-3, -1))
    return found


def to_pixels(cells: NDArray[np.bool_], grid: int, height: int, width: int) -> NDArray[np.bool_]:
    """Cells as pixels, bool (..., rows, columns) -> (..., height, width); False beyond the last cell."""
    out = np.zeros((*cells.shape[:-2], height, width), np.bool_)
    rows, columns = cells.shape[-2:]
    out[..., : rows * grid, : columns * grid] = cells.repeat(grid, axis=-2).repeat(grid, axis=-1)
    return out
