"""The layers of the SDK, read from the imports."""

import ast
from functools import cache
from pathlib import Path

import pytest

SDK = Path(__file__).parents[2] / "evlcp_sdk"

LAYERS = (
    {"errors", "files", "kernels", "late", "printable", "signals", "specs", "spelling", "stopwatch"},
    {"air"},
    {"values", "scene", "clock", "utc", "_kernels"},
    {"plugin"},
    {"link"},
    {"io", "rx", "place", "sim"},
    {"formatting"},
    {"diagnosis"},
    {"results"},
    {"report"},
    {"study", "live"},
    {"run", "simulated", "warming"},
    {"testing"},
    {"cli"},
)
"""From the ground up: a module imports from its own layer and those below."""


def layer_of(module: str) -> int:
    """Layer of a module named from the package's root; the longest name decides."""
    parts = module.split(".")
    for n in range(len(parts), 0, -1):
        for i, names in enumerate(LAYERS):
            if ".".join(parts[:n]) in names:
                return i
    raise AssertionError(f"evlcp_sdk.{module}: put it in a layer")


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Every absolute module name that a file imports, also inside functions and for typing only."""
    found: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                own = SDK.parent / inner.replace(".", "/")
                found.add(inner if own.is_dir() or own.with_suffix(".py").exists() else node.module)
    return frozenset(found)


def modules(folder: Path) -> dict[str, Path]:
    found = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name:
            found[name] = path
    return found


MODULES = modules(SDK)


def test_imports_go_down_and_none_is_of_a_plugin() -> None:
    plugins = {p.name for p in (SDK.parent / "plugins").iterdir()} | {"firmware_host"}
    for module, path in MODULES.items():
        for name in imports_of(path):
            assert name.split(".")[0] not in plugins, f"evlcp_sdk.{module} imports the plugin {name}"
            if name.startswith("evlcp_sdk."):
                above = layer_of(name.removeprefix("evlcp_sdk.")) > layer_of(module)
                assert not above, f"evlcp_sdk.{module} imports {name}, which stands above it"


BOARD = ("errors build flicker images", "protocol", "ports", "emulators", "board", "loop", "commands")
"""The layers of the board's host tool."""


def test_imports_of_the_board_go_down() -> None:
    def layer(module: str) -> int:
        (level,) = (n for n, names in enumerate(BOARD) if module.split(".")[0] in names.split())
        return level

    found = modules(SDK.parent / "firmware_host")
    for module, path in found.items():
        for name in imports_of(path):
            if name.startswith("firmware_host."):
                other = name.removeprefix("firmware_host.")
                assert layer(other) <= layer(module), f"{module} imports {other}, which is above"
                assert other != "protocol.generate", "the generator is a developer's tool"


@pytest.mark.parametrize("package", ["io", "rx", "place", "sim"])
def test_the_middle_packages_do_not_import_one_another(package: str) -> None:
    others = {"io", "rx", "place", "sim"} - {package}
    for module, path in MODULES.items():
        if module.split(".")[0] == package:
            for name in imports_of(path):
                assert name.removeprefix("evlcp_sdk.").split(".")[0] not in others, f"{module} imports {name}"


RX = (
    {"boxes", "limits", "straight"},
    {"rhythm", "sweeps"},
    {"guard", "regions", "trust"},
    {"detected", "framer"},
    {"inbox", "placement", "ranges"},
    {"points", "spread"},
    {"alignment"},
    {"reflections", "reading"},
    {"plugin_framing", "transmitters", "workers"},
    {"framing", "multi"},
    {"receiver"},
)
"""The receiver from its stages up to what joins them: a module imports from below its own row only."""


def test_receiver_stages_do_not_import_one_another() -> None:
    row = {name: i for i, names in enumerate(RX) for name in names}
    modules = [m.removeprefix("rx.") for m in MODULES if m.startswith("rx.") and not m.startswith("rx._")]
    assert sorted(row) == sorted(modules)
    for module in modules:
        for name in imports_of(MODULES[f"rx.{module}"]):
            other = name.removeprefix("evlcp_sdk.")
            if other.startswith("rx.") and not other.startswith("rx._"):
                assert row[other.removeprefix("rx.")] < row[module], f"{module} imports {name}"


def test_commands_do_not_import_one_another() -> None:
    commands = [m for m in MODULES if m.startswith("cli.") and not m.startswith("cli._") and m != "cli.main"]
    assert len(commands) > 8
    for module in commands:
        for name in imports_of(MODULES[module]):
            other = name.removeprefix("evlcp_sdk.")
            assert not other.startswith("cli.") or other.startswith("cli._"), f"{module} imports {name}"


@pytest.mark.parametrize("package", ["evlcp_sdk", "firmware_host"])
def test_no_import_circle(package: str) -> None:
    """Imports inside functions and for typing count, too; that of a package's own parts does not."""
    found, done = modules(SDK.parent / package), set[str]()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, f"circle: {' > '.join([*path, module])}"
        if module in done:
            return
        for name in imports_of(found[module]):
            other = name.removeprefix(f"{package}.")
            if other != name and other in found and other != module:
                visit(other, (*path, module))
        done.add(module)

    for module in found:
        visit(module, ())
    assert done == set(found)


def test_no_two_public_classes_have_one_name() -> None:
    homes: dict[str, list[Path]] = {}
    root = SDK.parent
    for path in (
        p for room in ("evlcp_sdk", "firmware_host", "plugins") for p in (root / room).rglob("*.py")
    ):
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(path)
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}
