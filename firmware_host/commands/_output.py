"""What commands write; files are there whole and together, or as they were before."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.files import Outputs

__all__ = ["save_array"]


def save_array(path: Path, array: "NDArray[np.generic]", outputs: "Outputs") -> None:
    """Write an array as `.npy` under exactly this name.

    Args:
        path: The file.
        array: What it holds.
        outputs: The files that it comes into place with.

    Raises:
        OutputError: The file cannot be written.
    """
    import io

    import numpy as np

    # To a file itself NumPy writes past Python, which a pipe cannot take.
    whole = io.BytesIO()
    np.save(whole, array)
    with outputs.told(path):
        outputs.open_binary(path).write(whole.getbuffer())
