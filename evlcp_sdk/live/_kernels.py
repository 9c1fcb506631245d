"""Every numba kernel of `evlcp_sdk.live`."""

from typing import Any

from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

__all__ = ["paint"]


@njit(cache=True, nogil=True)
def paint(cells: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> None:
    """Mark in `cells`, uint8 (height, width), which polarities each pixel has: bit 0 OFF, bit 1 ON."""
    height, width = cells.shape
    for i in range(len(x)):
        row, column = y[i], x[i]
        if row < height and column < width:
            cells[row, column] |= 1 << p[i]
