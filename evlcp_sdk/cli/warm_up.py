"""`evlcp warm-up`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, console, print_json, progress_bar
from evlcp_sdk.formatting import format_count

_SCENE = ("duration_s=0.2", "motion.vib_rate_rad_s=0.3", "bars.payload=messages", "bars.text=warm")
"""A short drive with so much vibration that every way of decoding is needed."""


def warm_up(as_json: Json = False) -> None:
    """Compile the kernels now: no later command waits for them.

    They are kept beside the package, or in your home where that cannot be written. It takes a minute or two,
    or a few seconds where all have been compiled.

    In an image, before workers start:  [bold]evlcp warm-up[/]
    """
    with progress_bar("compiling") as advance:
        result = compile_kernels(advance)
    if as_json:
        print_json(result)
        return
    if not result["compiled"]:
        console().print(f"nothing to compile; tried in {result['elapsed_s']:.1f} s")
        return
    compiled = format_count(result["compiled"], "kernel")
    console().print(f"{compiled} compiled in {result['elapsed_s']:.0f} s")
    if result["kept_in"] is None:
        console().print(
            "they cannot be kept, so each process compiles them again: give it a home, or a folder by"
            " NUMBA_CACHE_DIR",
            style="yellow",
        )


def compile_kernels(advance: Callable[[int, int], None]) -> dict[str, Any]:
    """Simulate and receive a fifth of a second with the default link; later processes find its kernels.

    Returns:
        How many kernels were compiled, the wall-clock time, s, and the folder that keeps them, or None.
    """
    compiled_before, start_s = sdk.kernels.count_compiled(), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="evlcp-warm-up-") as name:
        recording = Path(name) / "drive.raw"
        advance(0, 2)
        sdk.simulated.simulate("drive-30kmh", overrides=_SCENE).save(recording)
        advance(1, 2)
        sdk.run.receive_to_folder(recording, Path(name) / "out")
    compiled, elapsed_s = sdk.kernels.count_compiled() - compiled_before, time.perf_counter() - start_s
    folder = sdk.kernels.find_cache_folder()
    return {"compiled": compiled, "elapsed_s": elapsed_s, "kept_in": None if folder is None else str(folder)}
