"""Self-contained pages: their look, tables, and how they are written; nothing in them asks the network.

What is not `Markup` is plain text and is escaped where it enters a page, whatever wrote it; and a page lets
no script run but those that it was written with.
"""

import base64
import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

__all__ = ["Bar", "Markup", "bars", "details", "document", "escape", "table", "tiles"]

_CSS = """
:root { color-scheme: light dark; --ink: #333; --dim: #666; --line: #e6e6e6; --paper: #fff;
  --panel: #f6f6f6; --good: #00694b; --bad: #a03c00 }
@media (prefers-color-scheme: dark) { :root { --ink: #ddd; --dim: #a0a0a0; --line: #3c3c3c; --paper: #161616;
  --panel: #242424; --good: #4cc38a; --bad: #ff9a5c } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 70rem;
  margin: 2rem auto; padding: 0 1rem }
a { color: inherit } h1 { font-size: 1.5rem; overflow-wrap: anywhere }
h2 { font-size: 1.15rem; margin: 2.5rem 0 0.3rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.87rem; margin: 0.6rem 0 }
th, td { padding: 0.15rem 0.7rem; text-align: right; border-bottom: 1px solid var(--line);
  white-space: nowrap }
th { color: var(--dim); font-weight: 600 } td:first-child, th:first-child { text-align: left }
.chart { height: 430px } .note, .digest { color: var(--dim); font-size: 0.87rem }
.note, .digest { overflow-wrap: anywhere } .wide { overflow-x: auto }
.yes { color: var(--good) } .no { color: var(--bad); font-weight: 600 }
pre { background: var(--panel); padding: 0.7rem; overflow-x: auto; font-size: 0.8rem }
summary { cursor: pointer }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: 0.6rem;
  margin: 1rem 0 }
.tile { background: var(--panel); border-radius: 0.4rem; padding: 0.5rem 0.8rem }
.tile span { display: block; color: var(--dim); font-size: 0.8rem }
.tile b { display: block; font-size: 1.15rem; font-weight: 600; overflow-wrap: anywhere }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(20rem, 100%), 1fr));
  gap: 0.4rem 2rem } .bars { margin: 0.6rem 0; font-size: 0.85rem } .bars b { color: var(--dim) }
.bar { display: grid; grid-template-columns: minmax(4rem, 35%) 1fr 5.5rem; gap: 0.6rem; align-items: center }
.bar span { overflow-wrap: anywhere } .bar span:last-child { font-variant-numeric: tabular-nums }
.bar div { position: relative; height: 0.75rem; background: var(--panel) }
.bar i { position: absolute; inset: 0 auto 0 0; background: #0072b2 } .bar.best i { background: #009e73 }
.bar.dim i { background: var(--dim) }
.bar u { position: absolute; top: 25%; bottom: 25%; border: 1px solid var(--ink); border-width: 0 1px;
  background: linear-gradient(var(--ink), var(--ink)) center / 100% 1px no-repeat }
"""

_PAGE = Markup(
    """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{css}</style>
</head>
<body>
{body}
</body>
</html>
"""
)


def document(
    title: str,
    body: Iterable[str],
    scripts: Sequence[str] = (),
    data: Mapping[str, Any] | None = None,
    style: str = "",
    *,
    connect: bool = False,
) -> str:
    """A whole page.

    Args:
        title: Plain text.
        body: `Markup`; any other text is escaped.
        scripts: JavaScript, run in this order once the body is there; written by us, nothing of it by others.
        data: What the scripts read, as JSON: name to values. The text of the script element with the id
            `name` is the JSON of its values.
        style: CSS of this page's own, after that of all pages; written by us.
        connect: Scripts may talk to the server that the page comes from.

    Raises:
        ValueError: A script holds what would end its element.
    """
    parts = [Markup("{}").format(part) for part in body]
    for name, values in (data or {}).items():
        held = Markup('<script type="application/json" id="{}">{}</script>')
        parts.append(held.format(name, Markup(_json(values))))
    sources = []
    for script in scripts:
        if re.search("</script", script, re.IGNORECASE):
            raise ValueError("a script that would end its own element")
        # As a browser reads it.
        script = script.replace("\r\n", "\n").replace("\r", "\n")
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        sources.append(f"'sha256-{digest}'")
        parts.append(Markup("<script>{}</script>").format(Markup(script)))
    policy = (
        "default-src 'none'; img-src data: blob:; base-uri 'none'; form-action 'none';"
        # Charts style themselves.
        + (" connect-src 'self';" if connect else "")
        + " style-src 'unsafe-inline'; script-src "
        + (" ".join(sources) or "'none'")
    )
    # The quotes of a policy are those that it is known by.
    return str(
        _PAGE.format(
            policy=Markup(policy), title=title, css=Markup(_CSS + style), body=Markup("\n").join(parts)
        )
    )


def _json(values: Any) -> str:
    """JSON that ends no script element, whatever texts are in it: none of its characters is markup."""
    text = json.dumps(values, allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """A table; cells that are no `Markup` are escaped."""

    def line(tag: str, values: Sequence[str]) -> Markup:
        cell = Markup(f"<{tag}>{{}}</{tag}>")
        return Markup("<tr>{}</tr>").format(Markup("").join(cell.format(v) for v in values))

    lines = Markup("\n").join([line("th", head), *(line("td", row) for row in rows)])
    return Markup('<div class="wide"><table>{}</table></div>').format(lines)


def details(title: str, values: Any) -> Markup:
    """JSON values that show when their title is clicked."""
    held = Markup('<details><summary class="digest">{}</summary><pre>{}</pre></details>')
    return held.format(title, json.dumps(values, indent=1, sort_keys=True))


def tiles(figures: Iterable[tuple[str, str, str]]) -> Markup:
    """Headline figures side by side: what each is, its value, and what is to be said of it (may be empty)."""
    tile = Markup('<div class="tile"><span>{}</span><b>{}</b>{}</div>')
    said = Markup("<span>{}</span>")
    held = Markup("\n").join(
        tile.format(what, value, said.format(note) if note else "") for what, value, note in figures
    )
    return Markup('<div class="tiles">{}</div>').format(held)


@dataclass(frozen=True)
class Bar:
    """A figure as a bar.

    Attributes:
        name: What it is of.
        value: Its length, at least 0.
        text: The figure as it is written.
        low: Lower end of its interval; NaN where there is none.
        high: Upper end.
        best: It is to stand out.
        dim: It is a reference.
    """

    name: str
    value: float
    text: str
    low: float = math.nan
    high: float = math.nan
    best: bool = False
    dim: bool = False


def bars(title: str, values: Sequence[Bar]) -> Markup:
    """Figures below one another, to one scale from 0, with their intervals."""
    longest = max((v for one in values for v in (one.value, one.high) if math.isfinite(v)), default=0) or 1
    bar = Markup('<div class="{}"><span>{}</span><div><i style="width:{}%"></i>{}</div><span>{}</span></div>')
    span = Markup('<u style="left:{}%;width:{}%"></u>')
    lines = []
    for one in values:
        ends = ""
        if one.high > one.low:
            ends = span.format(_percent(one.low, longest), _percent(one.high - one.low, longest))
        kind = "bar" + " best" * one.best + " dim" * one.dim
        lines.append(bar.format(kind, one.name, _percent(one.value, longest), ends, one.text))
    return Markup('<div class="bars"><b>{}</b>{}</div>').format(title, Markup("").join(lines))


def _percent(value: float, of: float) -> str:
    return f"{100 * value / of:.2f}"
