"""The layers of the SDK, read from the imports."""

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SDK = ROOT / "evlcp_sdk"

ROWS = {
    "evlcp_sdk": (
        *("errors files formatting kernels lazy signals specs stopwatch", "air"),
        *("values scene clock utc _kernels", "plugin", "link", "io rx place sim", "diagnosis"),
        *("results", "report", "study live", "run simulated surveying", "testing", "cli"),
    ),
    "evlcp_sdk/rx": (
        *("_kernels", "boxes distortion limits", "rhythm sweeps", "guard regions trust", "detector"),
        *("inbox placement ranges", "points spread", "alignment reflections", "framer", "reading"),
        *("plugin_framing workers", "transmitters", "framing multi", "receiver"),
    ),
    "firmware_host": (
        *("errors build flicker images", "protocol", "ports", "emulators", "board", "loop", "commands"),
    ),
}
"""Of a package, from the ground up: a room imports from below its row only, a lone module beside it, too."""


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
                own = ROOT / inner.replace(".", "/")
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


@pytest.mark.parametrize("package", ROWS)
def test_imports_go_down(package: str) -> None:
    folder = ROOT / package
    row = {name: i for i, names in enumerate(ROWS[package]) for name in names.split()}
    found = modules(folder)
    assert {module.split(".")[0] for module in found} == set(row)
    for module, path in found.items():
        own = module.split(".")[0]
        # The receiver's stages are rooms of their own.
        room = (folder / own).is_dir() or package == "evlcp_sdk/rx"
        for name in imports_of(path):
            inside, _, other = name.partition(package.replace("/", ".") + ".")
            below = other.split(".")[0]
            if not inside and other and below != own:
                assert row[below] <= row[own] - room, f"{package}: {module} imports {other}"


def test_nothing_imports_a_plugin_or_the_generator() -> None:
    plugins = {path.name for path in (ROOT / "plugins").iterdir()} | {"firmware_host"}
    for module, path in MODULES.items():
        named = {name.split(".")[0] for name in imports_of(path)} & plugins
        assert not named, f"evlcp_sdk.{module} imports the plugin {named}"
    for path in (ROOT / "firmware_host").rglob("*.py"):
        assert "firmware_host.protocol.generate" not in imports_of(path), "it is a developer's tool"


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
    found, done = modules(ROOT / package), set[str]()

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
    for path in (
        p for room in ("evlcp_sdk", "firmware_host", "plugins") for p in (ROOT / room).rglob("*.py")
    ):
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(path)
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}
