"""The layers of the transmitter's host tool, read from the imports."""

from pathlib import Path

import pytest

from tests.unit.test_layers import imports_of

ROOT = Path(__file__).parents[2]
HOST = ROOT / "firmware_host"

LAYERS = ("errors build flicker images", "protocol", "ports", "emulators", "board", "loop", "commands")
"""From the ground up: a module imports from its own layer and those below; lazy imports count."""

ATOP = {""}
"""The package itself, which adds its commands to the command line."""


def name_of(path: Path) -> str:
    parts = path.relative_to(HOST).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(HOST.rglob("*.py"))}


def layer_of(module: str) -> int:
    first = module.split(".")[0]
    for level, names in enumerate(LAYERS):
        if first in names.split():
            return level
    raise AssertionError(f"firmware_host.{module}: put it in a layer")


def own_imports(module: str) -> set[str]:
    found = (name for name in imports_of(MODULES[module]) if name.startswith("firmware_host."))
    return {name.removeprefix("firmware_host.") for name in found}


@pytest.mark.parametrize("module", [m for m in MODULES if m not in ATOP])
def test_imports_go_down(module: str) -> None:
    for other in own_imports(module):
        assert layer_of(other) <= layer_of(module), f"firmware_host.{module} imports {other}, which is above"


def test_no_import_circle() -> None:
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, f"circle: {' > '.join([*path, module])}"
        if module in MODULES and module not in done:
            for other in own_imports(module) - {module}:
                visit(other, (*path, module))
            done.add(module)

    for module in MODULES:
        visit(module, ())
    assert done == set(MODULES)


def test_the_generator_is_a_developers_tool() -> None:
    users = [module for module in MODULES if "protocol.generate" in own_imports(module)]
    assert users == []
