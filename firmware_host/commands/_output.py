"""What commands write."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["save_array"]


def save_array(path: Path, array: "NDArray[np.generic]") -> None:
    """Write an array as `.npy` under exactly this name.

    Raises:
        InputError: The file cannot be written.
    """
    import numpy as np

    from evlcp_sdk.errors import InputError

    try:
        with path.open("wb") as file:
            np.save(file, array)
    except OSError as fault:
        raise InputError(f"{path}: cannot be written: {fault.strerror}") from fault
