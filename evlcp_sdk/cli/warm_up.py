"""`evlcp warm-up`."""

from __future__ import annotations

from evlcp_sdk.cli._common import Json, console, print_json, progress_bar


def warm_up(as_json: Json = False) -> None:
    """Compile the kernels now: no later command waits for them.

    They are kept beside the package, or in your home where that cannot be written. It takes a minute or two,
    or a few seconds where all have been compiled.

    In an image, before workers start:  [bold]evlcp warm-up[/]
    """
    from evlcp_sdk.formatting import format_count
    from evlcp_sdk.warming import STEPS, warm_up as warm

    with progress_bar("compiling") as advance:
        result = warm(lambda step: advance(STEPS.index(step), len(STEPS)))
    if as_json:
        print_json(result)
        return
    compiled, elapsed_s = result["compiled"], result["elapsed_s"]
    if not compiled:
        console().print(f"nothing to compile; tried in {elapsed_s:.1f} s")
        return
    console().print(f"{format_count(compiled, 'kernel')} compiled in {elapsed_s:.0f} s")
    if result["kept_in"] is None:
        console().print(
            "they cannot be kept, so each process compiles them again: give it a home, or a folder by"
            " NUMBA_CACHE_DIR",
            style="yellow",
        )
