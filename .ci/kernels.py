"""Compile the kernels for processors of level x86-64-v3 into build/kernels, which goes into the wheel."""

import os
import sys
import tempfile
from pathlib import Path

BUILT = Path(__file__).parents[1] / "build" / "kernels"
FOR_LEVEL = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": "+avx2"}


def main() -> None:
    """Compile, pack, say how large it is."""
    if any(os.environ.get(name) != value for name, value in FOR_LEVEL.items()):
        # Numba reads them as it is imported. A cache of its own: what is packed is what this source gives.
        with tempfile.TemporaryDirectory() as cache:
            own = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
            sys.exit(
                os.spawnve(
                    os.P_WAIT,
                    sys.executable,
                    [sys.executable, *sys.argv],
                    own | FOR_LEVEL | {"NUMBA_CACHE_DIR": cache},
                )
            )
    from evlcp_sdk.kernels import pack
    from evlcp_sdk.warming import warm_up

    for old in BUILT.glob("*.bin"):
        old.unlink()
    warmth = warm_up()
    path = pack(BUILT)
    sys.stdout.write(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB; {warmth.elapsed_s:.0f} s\n")


if __name__ == "__main__":
    main()
