"""The messages that end a command, read from the code: what each says, its exit code and its cause."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import evlcp_sdk.errors
import firmware_host.errors

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("evlcp_sdk", "firmware_host", "plugins")

EXIT_CODES = {
    name: cls.exit_code
    for module in (evlcp_sdk.errors, firmware_host.errors)
    for name, cls in vars(module).items()
    if isinstance(cls, type) and issubclass(cls, evlcp_sdk.errors.EvlcpError)
}
"""Exit code of each exception of the SDK."""

_REPORTERS = {"complain": 0, "BadParameter": 2, "SpecError": 2}
"""What else carries a message to the terminal, and its exit code; 0 where the line alone ends nothing."""


@dataclass(frozen=True, order=True)
class Report:
    """One message.

    Attributes:
        text: What it says, variable parts in capitals.
        kind: The exception, or the function that prints it.
        exit_code: How the command ends, 0 where the message is a warning.
        cause: When it is raised, by the docstring of the function that does; may be empty.
        module: Where.
    """

    text: str
    kind: str
    exit_code: int
    cause: str
    module: str


def messages() -> list[Report]:
    """All messages of the SDK, in the order of their modules."""
    found = []
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found += _of_module(path, name.removeprefix("plugins.").removesuffix(".__init__"))
    return list(dict.fromkeys(found))


def as_markdown(found: list[Report]) -> str:
    """A table a package."""
    packages: dict[str, list[Report]] = {}
    for one in found:
        packages.setdefault(".".join(one.module.split(".")[:2]), []).append(one)
    parts = []
    for package, those in packages.items():
        parts.append(f"\n## {package}\n\n| message | ends with | cause |\n|---|---|---|")
        parts += [
            f"| {_code(one.text)} | {one.exit_code or 'a warning'} | {_cell(one.cause)} `{one.module}` |"
            for one in those
        ]
    return "\n".join(parts) + "\n"


def _of_module(path: Path, module: str) -> Iterator[Report]:
    """The messages of a file."""

    def walk(node: ast.AST, doc: str) -> Iterator[Report]:
        for child in ast.iter_child_nodes(node):
            inner = doc
            if isinstance(child, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                inner = ast.get_docstring(child) or doc
            if isinstance(child, ast.Call):
                name = getattr(child.func, "id", getattr(child.func, "attr", ""))
                if name in EXIT_CODES or name in _REPORTERS:
                    text = ", ".join(filter(None, map(_text, child.args)))
                    if re.search(r"[a-z]{3}", text):
                        code = EXIT_CODES.get(name, _REPORTERS.get(name, 0))
                        yield Report(text, name, code, _cause(doc, name), module)
            yield from walk(child, inner)

    yield from walk(ast.parse(path.read_text(encoding="utf-8")), "")


def _text(node: ast.expr) -> str:
    """Text of an expression, its variable parts in capitals; empty without a word of its own."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(
            _placeholder(part.value) if isinstance(part, ast.FormattedValue) else str(part.value)  # type: ignore[attr-defined]
            for part in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        sides = [_text(side) or _placeholder(side) for side in (node.left, node.right)]
        return "".join(sides) if _text(node.left) or _text(node.right) else ""
    if isinstance(node, ast.IfExp):
        return " / ".join(filter(None, (_text(node.body), _text(node.orelse))))
    return ""


def _placeholder(node: ast.expr) -> str:
    """Name of a variable part, in capitals."""
    while isinstance(node, ast.Call | ast.Attribute | ast.Subscript):
        if isinstance(node, ast.Attribute) and node.attr not in ("name", "value", "shape", "message"):
            return node.attr.strip("_").upper()
        if isinstance(node, ast.Call):
            if not node.args:
                node = node.func
                continue
            node = node.args[0]
        else:
            node = node.value
    return node.id.strip("_").upper() if isinstance(node, ast.Name) else "..."


def _cause(doc: str, name: str) -> str:
    """When an exception is raised, by a docstring."""
    section = doc.partition("\nRaises:\n")[2].partition("\n\n")[0]
    entry = re.search(rf"^ {{4}}(?:\w+, )*{name}[\w, ]*: (.*(?:\n {{8}}.*)*)", section, re.MULTILINE)
    return " ".join(entry[1].split()) if entry else ""


def _code(text: str) -> str:
    """Text in a cell as code."""
    plain = " ".join(text.split()).replace("|", "\\|")
    return f"`` {plain} ``" if "`" in plain else f"`{plain}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
