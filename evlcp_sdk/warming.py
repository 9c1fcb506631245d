"""Kernels compiled before they are needed, by doing once what needs them."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evlcp_sdk.kernels import count_compiled, find_cache_folder
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.simulated import simulate

STEPS = ("simulate", "receive")
"""What is done, in this order."""

_SCENE = ("duration_s=0.2", "motion.vib_rate_rad_s=0.3", "bars.payload=messages", "bars.text=warm")
"""A drive so short, and so shaken that each way of decoding is needed."""


@dataclass(frozen=True)
class Warmth:
    """What a warm-up took.

    Attributes:
        compiled: Kernels that were not there and are now.
        elapsed_s: Time on the clock, s.
        kept_in: A folder that they are kept in; None where none can be written, so that the next process
            compiles them again.
    """

    compiled: int
    elapsed_s: float
    kept_in: Path | None


def warm_up(advance: Callable[[str], None] = lambda _step: None) -> Warmth:
    """Simulate and receive a fifth of a second with the default link.

    What that compiles is kept for later processes.

    Args:
        advance: Called with the name of a step of `STEPS` when it begins.
    """
    compiled, began_s = count_compiled(), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="evlcp-warm-up-") as name:
        recording = Path(name) / "drive.raw"
        advance("simulate")
        simulate("drive-30kmh", overrides=_SCENE).save(recording)
        advance("receive")
        receive_to_folder(recording, Path(name) / "out")
    return Warmth(count_compiled() - compiled, time.perf_counter() - began_s, find_cache_folder())
