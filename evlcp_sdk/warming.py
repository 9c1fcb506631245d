"""Kernels compiled ahead of their use, by a short run that needs them."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evlcp_sdk.kernels import count_compiled, find_cache_folder
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.simulated import simulate

STEPS = ("simulate", "receive")
"""The steps of a warm-up, in this order."""

_SCENE = ("duration_s=0.2", "motion.vib_rate_rad_s=0.3", "bars.payload=messages", "bars.text=warm")
"""A short drive with so much vibration that every way of decoding is needed."""


def warm_up(advance: Callable[[str], None] = lambda _step: None) -> dict[str, Any]:
    """Simulate and receive a fifth of a second with the default link; later processes find its kernels.

    `advance` is called with the name of a step of `STEPS` when it begins.

    Returns:
        `compiled`: how many kernels were compiled; `elapsed_s`; and `kept_in`: the folder of their cache, or
        None where none can be written, so that the next process compiles them again.
    """
    compiled_before, start_s = count_compiled(), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="evlcp-warm-up-") as name:
        recording = Path(name) / "drive.raw"
        advance("simulate")
        simulate("drive-30kmh", overrides=_SCENE).save(recording)
        advance("receive")
        receive_to_folder(recording, Path(name) / "out")
    folder = find_cache_folder()
    return {
        "compiled": count_compiled() - compiled_before,
        "elapsed_s": time.perf_counter() - start_s,
        "kept_in": None if folder is None else str(folder),
    }
