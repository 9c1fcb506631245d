"""The drawing of the link, from text to text: docs/images/link.svg.

    python docs/figures/link.py docs/images/link.svg

Symbols and chips in it are those of the message. Its colours follow the reader's scheme.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

import evlcp_sdk as evlcp
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.report.colours import cluster_colours

TEXT = "Road works"
TOP, HIGH = 34, 176
"""Where each step's picture begins, and how high it is, in the drawing's units."""

STEP = 114
WIDTH, HEIGHT = 9 * STEP + 16, 284

STYLE = """
svg { color-scheme: light dark }
text { font: 12.5px system-ui, sans-serif; fill: #444; text-anchor: middle }
.big { font-size: 13px; font-weight: 600; fill: #222 } .symbol { font-size: 10px; fill: #222 }
.line { stroke: #888; stroke-width: 1.5; fill: none } .bubble { fill: #eef3f7; stroke: #0072b2 }
.lit { fill: #f0b429 } .dark { fill: #d8d8d8 } .rise { fill: #d99a00 } .fall { fill: #2f7fd6 }
.body { fill: #5b6570 } .lens { fill: #9db4c6 } .side { font-size: 13px; font-weight: 600; fill: #0072b2 }
@media (prefers-color-scheme: dark) {
  text { fill: #b8b8b8 } .big, .symbol { fill: #eee } .line { stroke: #888 }
  .bubble { fill: #1d2a33; stroke: #56b4e9 } .dark { fill: #3a3a3a } .rise { fill: #f6c744 }
  .fall { fill: #5aa2f0 } .body { fill: #8a96a3 } .lens { fill: #4f6b80 } .side { fill: #56b4e9 }
}
"""


def rectangle(x: float, y: float, width: float, height: float, style: str) -> str:
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" {style}/>'


def draw_text(x: float, y: float, text: str, style: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{escape(text)}</text>'


def bubble(middle: float) -> str:
    path = f"M{middle - 50} {TOP + 60}h100v44h-42l-14 16v-16h-44z"
    return f'<path class="bubble" d="{path}"/>' + draw_text(middle, TOP + 87, TEXT, 'class="big"')


def strip(x: float, colours: Sequence[str], wide: float = 16) -> str:
    """The clusters of a bar, below one another."""
    high = HIGH / len(colours)
    return "".join(
        rectangle(x, TOP + k * high, wide, high - 1, f'fill="{colour}"') for k, colour in enumerate(colours)
    )


def numbers(middle: float, symbols: NDArray[np.int64], colours: Sequence[str]) -> str:
    """The symbol of each cluster beside its colour."""
    high = HIGH / len(symbols)
    return strip(middle - 24, colours, 8) + "".join(
        draw_text(middle + 4, TOP + (k + 0.75) * high, str(symbol), 'class="symbol"')
        for k, symbol in enumerate(symbols)
    )


def cells(middle: float, looks: Sequence[Sequence[str]], wide: float) -> str:
    """Rows of small squares, each of a class of the style; empty for none."""
    high = HIGH / len(looks)
    left = middle - wide * len(looks[0]) / 2
    return "".join(
        rectangle(left + wide * i, TOP + k * high, wide - 0.6, high - 1, f'class="{style}"')
        for k, row in enumerate(looks)
        for i, style in enumerate(row)
        if style
    )


def drawing() -> str:
    """The whole drawing."""
    link = load_link()
    symbols = evlcp.compose(link, text=TEXT, sequence=0)[0, 0]
    pilots, words = (link.codebook.pilots, link.codebook.codewords)
    chips = np.concatenate([pilots, words[symbols]], axis=1)[:, :18]
    edges = np.diff(chips.astype(int), axis=1)
    rgb = np.round(255 * cluster_colours(len(symbols))).astype(int)
    colours = [f"rgb({r},{g},{b})" for r, g, b in rgb.tolist()]
    at = [STEP * (n + 0.5) + 8 for n in range(9)]
    rng = np.random.default_rng(1)
    events = np.repeat(edges[:, 6, None], 5, axis=1) * (rng.random((len(symbols), 5)) < 0.85)
    rate = f"{link.packet.chip_rate_hz:,.0f}".replace(",", " ")
    parts = [
        bubble(at[0]),
        numbers(at[1], symbols, colours),
        cells(at[2], [["lit" if chip else "dark" for chip in row[:14]] for row in chips], 6),
        rectangle(at[3] - 9, TOP - 4, 18, HIGH + 8, 'class="body" rx="3"'),
        *(
            f'<circle cx="{at[3]}" cy="{TOP + (k + 0.5) * HIGH / 16:.1f}" r="4.2"'
            f' class="{"lit" if chip else "dark"}"/>'
            for k, chip in enumerate(chips[:, 6])
        ),
        *(
            f'<path class="line" stroke-dasharray="3 4" d="M{at[3] + 16} {TOP + y}L{at[4] - 40} {TOP + 88}"/>'
            for y in (8, 88, 168)
        ),
        rectangle(at[4] - 14, TOP + 62, 44, 52, 'class="body" rx="5"'),
        rectangle(at[4] - 32, TOP + 70, 18, 36, 'class="lens" rx="3"'),
        cells(at[5], [[("", "rise", "fall")[e] for e in row] for row in events.tolist()], 8),
        strip(at[6] - 9, colours, 18),
        numbers(at[7] - 8, symbols, colours),
        f'<path class="line" d="M{at[7] + 22} {TOP + 4}V{TOP + HIGH - 4}m-4 -6l4 6l4 -6"/>',
        f'<path class="line" d="M{at[7] + 18} {TOP + 10}l4 -6l4 6"/>',
        bubble(at[8]),
    ]
    for n in (0, 1, 2, 4, 5, 6, 7):
        x = (at[n] + at[n + 1]) / 2 + {0: 13, 1: -10, 4: 6, 7: -14}.get(n, 0)
        parts.append(f'<path class="line" d="M{x - 7:.1f} {TOP + 88}h12m-5 -5l5 5l-5 5"/>')
    captions = (
        ("a text", "or a beacon:", "where it stands"),
        ("symbols", "for 16 clusters,", "error-corrected"),
        ("chips", f"{rate} a second,", "after a pilot"),
        ("LED bar", "blinks too fast", "for the eye"),
        ("event camera", "sees only", "what changes"),
        ("events", "brighter, darker,", "to microseconds"),
        ("clusters", "found by", "their pilots"),
        ("symbols", "and distance,", "from the size"),
        ("the text", "and where", "the car is"),
    )
    for x, lines in zip(at, captions, strict=True):
        parts.append(draw_text(x, TOP + HIGH + 30, lines[0], 'class="big"'))
        parts += [draw_text(x, TOP + HIGH + 48 + 17 * i, line) for i, line in enumerate(lines[1:])]
    parts.append(draw_text((at[0] + at[3]) / 2, 18, "transmitter", 'class="side"'))
    parts.append(draw_text((at[4] + at[8]) / 2, 18, "receiver", 'class="side"'))
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">'
    title = f"<title>From text to text: “{TEXT}” by light</title><style>{STYLE}</style>"
    return "\n".join([head, title, *parts, "</svg>\n"])


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(drawing(), encoding="utf-8")
