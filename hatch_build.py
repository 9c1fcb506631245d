"""What hatchling adds to the wheel: kernels that `make wheel` has compiled."""

import os
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Kernels(BuildHookInterface):  # type: ignore[type-arg]
    """Takes the folder `EVLCP_KERNELS`, if it is named, into `evlcp_sdk/data/kernels` of a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before a wheel is built."""
        folder = os.environ.get("EVLCP_KERNELS")
        if version == "standard" and folder:
            for path in sorted(Path(self.root, folder).glob("*.bin")):
                build_data["force_include"][str(path)] = f"evlcp_sdk/data/kernels/{path.name}"
