"""What the site needs beside Sphinx: pages that are files of the repository, formulas without a script."""

import dataclasses
import importlib
import inspect
import json
import os
import pkgutil
import re
from pathlib import Path
from typing import Any, get_type_hints

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from error_index import as_markdown, messages
from myst_parser.parsers.sphinx_ import MystParser
from pydantic.fields import FieldInfo
from sphinx.application import Sphinx

import evlcp_sdk
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.testing import laws_of
from evlcp_sdk.testing.form import DESCRIPTION, FUNCTION, RESULT

ROOT = Path(__file__).resolve().parents[1]

PAGES = {
    "contributing": "CONTRIBUTING.md",
    "security": "SECURITY.md",
    "changelog": "CHANGELOG.md",
    "third-party-plugin": "examples/third_party_plugin/README.md",
    "third-party-formats": "examples/third_party_formats/README.md",
}
"""Pages of the site that are files of the repository."""

_PAGE_OF = {ROOT / name: page for page, name in PAGES.items()} | {ROOT / "README.md": "index"}


def slug_of(head: str) -> str:
    """A heading's anchor, spelt as in the links of the repository."""
    return head.lower().replace(" ", "-")


def on_site(text: str, path: Path) -> str:
    """Markdown of a file, its links as seen from docs/; what is not on the site becomes a download.

    Args:
        text: Markdown.
        path: The file that it is from.
    """

    def move_link(link: re.Match[str]) -> str:
        name, mark, anchor = link[1].partition("#")
        target = (path.parent / name).resolve()
        page = _PAGE_OF.get(target)
        if page is not None:
            return f"](/{page}.md{mark}{anchor})"
        if path.is_relative_to(ROOT / "docs"):
            return link[0]
        return f"](/{os.path.relpath(target, ROOT / 'docs')}{mark}{anchor})"

    return re.sub(r"\]\((?!\w+:|#)([^)\s]+)\)", move_link, text)


def with_reference(text: str) -> str:
    """Markdown with its lines `{names} NAME ...` and `{modules} PACKAGE` as directives of autodoc.

    A line `{errors}` becomes the table of all messages, `{laws}` that of the laws of all roles, and
    `{parameters} ROLE` that of the role's built-in algorithms.
    """
    if re.search(r"^\{errors\}$", text, re.MULTILINE):
        text = text.replace("\n{errors}\n", as_markdown(messages()))
    text = re.sub(r"^\{laws\}$", lambda _: _laws(), text, flags=re.MULTILINE)
    text = re.sub(r"^\{parameters\} (\S+)$", lambda line: _parameters(line[1]), text, flags=re.MULTILINE)
    text = re.sub(r"^\{names\} (.+)$", lambda line: _names(line[1].split()), text, flags=re.MULTILINE)
    return re.sub(r"^\{modules\} (\S+)$", lambda line: _modules(line[1]), text, flags=re.MULTILINE)


def _names(names: list[str]) -> str:
    """Names of the public face."""
    parts = []
    for name in names:
        thing = getattr(evlcp_sdk, name)
        kind = "function" if inspect.isroutine(thing) else "class" if isinstance(thing, type) else "data"
        if kind == "class" and issubclass(thing, BaseException):
            kind = "exception"
        members = "   :members:\n" if kind == "class" else ""
        parts.append(f".. auto{kind}:: evlcp_sdk.{name}\n{members}")
    return "```{eval-rst}\n" + "\n".join(parts) + "```"


def _modules(package: str) -> str:
    """The public modules of a package, or one module."""
    paths = getattr(importlib.import_module(package), "__path__", None)
    found = [package] if paths is None else []
    for one in pkgutil.walk_packages(paths or [], f"{package}."):
        if not one.ispkg and not any(part.startswith("_") for part in one.name.split(".")):
            found.append(one.name)
    return "\n\n".join(
        f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n```" for name in found
    )


def _parameters(role: str) -> str:
    """The parameters of a role's built-in algorithms."""
    registry = Registry.load()
    rows = ["| algorithm | parameter | default | meaning |", "|---|---|---|---|"]
    for entry in registry.list_algorithms(role):
        if entry.distribution == "evlcp-sdk":
            cls = registry.load_class(role, entry.algorithm.id)
            meanings = _descriptions(cls)
            for f in dataclasses.fields(cls):
                cells = f"`{entry.algorithm.id}`", f"`{f.name}`", json.dumps(f.default), meanings[f.name]
                rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _laws() -> str:
    """The laws of form, then those of each role."""
    tables = {"of form": (*DESCRIPTION, *FUNCTION, *RESULT)} | {role: laws_of(role) for role in ROLES}
    shared = {law.name for law in tables["of form"]}
    parts = []
    for head, laws in tables.items():
        parts.append(f"### {head}\n\n| law | meaning |\n|---|---|")
        parts[-1] += "".join(
            f"\n| `{law.name}` | {law.statement} |"
            for law in laws
            if head == "of form" or law.name not in shared
        )
    return "\n\n".join(parts)


def _read(app: Sphinx, page: str, source: list[str]) -> None:
    """Take a page from where its text is."""
    path = ROOT / PAGES[page] if page in PAGES else Path(app.env.doc2path(page))
    if path.suffix == ".md":
        app.env.note_dependency(path)
        app.env.note_dependency(__file__)
        if page in ("errors", "roles", "conformance"):
            app.env.note_reread()
        source[0] = with_reference(on_site(path.read_text(encoding="utf-8"), path))


def _descriptions(thing: Any) -> dict[str, str]:
    """Descriptions of the fields of a specification."""
    if not (isinstance(thing, type) and dataclasses.is_dataclass(thing)):
        return {}
    try:
        hints = get_type_hints(thing, include_extras=True)
    except NameError:  # a type that is imported for the type checker only
        return {}
    return {
        field.name: note.description
        for field in dataclasses.fields(thing)
        for note in getattr(hints[field.name], "__metadata__", ())
        if isinstance(note, FieldInfo) and note.description
    }


def _docstring(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Fenced blocks of a docstring as literal ones, and what the fields of a specification mean."""
    text, fenced = [], False
    for line in lines:
        if line.strip().startswith("```"):
            fenced = not fenced
            text += ["::", ""] if fenced else [""]
        else:
            text.append(f"    {line}" if fenced else line)
    if (meanings := _descriptions(thing)) and "Attributes:" not in lines:
        text += ["", "Attributes:", *(f"    {field}: {meaning}" for field, meaning in meanings.items()), ""]
    if what in ("attribute", "property", "data") and text and ":" in text[0]:
        text[0] = f": {text[0]}"  # Napoleon takes what stands before the first colon for a type
    lines[:] = text


_ARRAY = re.compile(
    r"~?(?:numpy\.)?ndarray\[tuple\[.*?\.\.\.\], ~?(?:numpy\.)?dtype\[~?(?:numpy\.)?(.+?)\]\]"
)


_LIKE = re.compile(r"~?(?:\w+\.)*_?Buffer \| .*? \| ~?(?:\w+\.)*_NestedSequence\[complex \| bytes \| str\]")


def _signature(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Arrays by their type alone, as their shapes are in the text; of a specification names and defaults."""
    if _descriptions(thing):
        parameters = inspect.signature(thing).parameters.values()
        plain = [p.replace(annotation=p.empty) for p in parameters]
        signature = str(inspect.Signature(plain)).replace("<factory>", "...")

    def shorten(text: str | None) -> str | None:
        return text and _LIKE.sub("ArrayLike", _ARRAY.sub(r"NDArray[\1]", text))

    return shorten(signature), shorten(returned)


class NotebookParser(MystParser):
    """A notebook as a page: its text, its code, and what that showed when it was run last."""

    supported = ("notebook",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """See `docutils.parsers.Parser`."""
        parts = []
        for cell in json.loads(inputstring)["cells"]:
            text = "".join(cell["source"])
            parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
            parts += filter(None, map(_show_output, cell.get("outputs", ())))
        super().parse("\n\n".join(parts) + "\n", document)


def _show_output(output: dict[str, Any]) -> str:
    """What a cell showed: a picture, a table, or text."""
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="What this cell draws" src="data:image/png;base64,{data["image/png"].strip()}">'
    if "text/html" in data:
        return "```{raw} html\n" + "".join(data["text/html"]) + "\n```"
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{text.rstrip()}\n```" if text.strip() else ""


def _inline_math(writer: Any, node: nodes.math) -> None:
    """A formula within a line."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block_math(writer: Any, node: nodes.math_block) -> None:
    """A formula of its own."""
    writer.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))
    app.add_source_suffix(".ipynb", "notebook")
    app.add_source_parser(NotebookParser)
    app.connect("source-read", _read)
    app.connect("autodoc-process-docstring", _docstring, priority=100)
    app.connect("autodoc-process-signature", _signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
