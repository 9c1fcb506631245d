"""What the site needs beside Sphinx: pages that are files of the repository, formulas without a script."""

import os
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx

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

    def moved(link: re.Match[str]) -> str:
        name, mark, anchor = link[1].partition("#")
        target = (path.parent / name).resolve()
        page = _PAGE_OF.get(target)
        if page is not None:
            return f"](/{page}.md{mark}{anchor})"
        if path.is_relative_to(ROOT / "docs"):
            return link[0]
        return f"](/{os.path.relpath(target, ROOT / 'docs')}{mark}{anchor})"

    return re.sub(r"\]\((?!\w+:|#)([^)\s]+)\)", moved, text)


def _read(app: Sphinx, page: str, source: list[str]) -> None:
    """Take a page from where its text is."""
    path = ROOT / PAGES[page] if page in PAGES else Path(app.env.doc2path(page))
    if path.suffix == ".md":
        app.env.note_dependency(path)
        source[0] = on_site(path.read_text(encoding="utf-8"), path)


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
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
