"""The layers of the transmitter's host tool, read from the imports."""

import pytest

from tests.unit.test_layers import SDK, imports_of, modules

LAYERS = ("errors build flicker images", "protocol", "ports", "emulators", "board", "loop", "commands")
"""From the ground up: a module imports from its own layer and those below; lazy imports count."""

MODULES = modules(SDK.parent / "firmware_host")


def layer_of(module: str) -> int:
    first = module.split(".")[0]
    (level,) = (n for n, names in enumerate(LAYERS) if first in names.split())
    return level


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_down(module: str) -> None:
    for name in imports_of(MODULES[module]):
        if name.startswith("firmware_host."):
            other = name.removeprefix("firmware_host.")
            assert layer_of(other) <= layer_of(module), f"{module} imports {other}, which is above"
            assert other != "protocol.generate", "the generator is a developer's tool"
