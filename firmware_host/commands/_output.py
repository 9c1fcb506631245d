"""What commands write; a file is there whole or as it was before."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["save_array"]


def save_array(path: Path, array: "NDArray[np.generic]") -> None:
    """Write an array as `.npy` under exactly this name.

    Raises:
        EvlcpError: The file cannot be written.
    """
    import numpy as np

    from evlcp_sdk.files import whole_file

    with whole_file(path) as part, part.open("wb") as file:
        np.save(file, array)
