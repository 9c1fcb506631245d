"""Self-contained pages: their look, tables, and how they are written; nothing in them asks the network."""

import html
import json
from collections.abc import Iterable, Sequence
from typing import Any

__all__ = ["details", "document", "table"]

_CSS = """
body { font: 15px/1.5 system-ui, sans-serif; color: #333; max-width: 70rem; margin: 2rem auto;
  padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin: 2.5rem 0 0.3rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.87rem; margin: 0.6rem 0 }
th, td { padding: 0.15rem 0.7rem; text-align: right; border-bottom: 1px solid #e6e6e6; white-space: nowrap }
th { color: #666; font-weight: 600 } td:first-child, th:first-child { text-align: left }
.chart { height: 430px } .note, .digest { color: #666; font-size: 0.87rem }
.digest { overflow-wrap: anywhere }
.yes { color: #00694b } .no { color: #a03c00; font-weight: 600 } .wide { overflow-x: auto }
pre { background: #f6f6f6; padding: 0.7rem; overflow-x: auto; font-size: 0.8rem } summary { cursor: pointer }
"""


def document(title: str, body: Iterable[str], head: str = "") -> str:
    """A whole page.

    Args:
        title: Plain text.
        body: HTML.
        head: HTML that the body needs, e.g. a script.
    """
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>{html.escape(title)}</title>\n<style>{_CSS}</style>",
            f"{head}</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; its cells are HTML."""

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(f"<{tag}>{v}</{tag}>" for v in values)

    lines = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>\n{lines}</table></div>'


def details(title: str, values: Any) -> str:
    """JSON values that show when their title is clicked."""
    text = html.escape(json.dumps(values, indent=1, sort_keys=True))
    return f'<details><summary class="digest">{html.escape(title)}</summary><pre>{text}</pre></details>'
