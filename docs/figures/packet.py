"""The drawing of a packet in time: docs/images/packet.svg.

    python docs/figures/packet.py docs/images/packet.svg

The beginning of a packet of the default link, chip by chip, as the clusters send it and as one pixel sees it;
below, the same 16 chips of other codes. Its colours follow the reader's scheme.
"""

import sys
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

import evlcp_sdk as evlcp
from evlcp_sdk.air.codebook import edges_of_chips
from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.link.resolve import load_link

CHIP, HIGH, LEFT, TOP = 10, 9, 118, 40
"""Width of a chip, height of a cluster, and where the first begins, in the drawing's units."""

OTHERS = (
    ("wh4x2", "pair code", ()),
    ("nrz", "balanced words, no return to zero", ("modulation.id=nrz",)),
    ("ppm", "4 positions", ("modulation.id=ppm",)),
    ("wh4x2-dimmed", "lit for a quarter", ("modulation.id=wh4x2-dimmed",)),
)

STYLE = """
svg { color-scheme: light dark }
text { font: 12px system-ui, sans-serif; fill: #444 } .big { font-weight: 600; fill: #222 }
.lit { fill: #f0b429 } .dark { fill: #dcdcdc } .rise { fill: #d99a00 } .fall { fill: #2f7fd6 }
.line { stroke: #888; stroke-width: 1 }
@media (prefers-color-scheme: dark) {
  text { fill: #b8b8b8 } .big { fill: #eee } .dark { fill: #3a3a3a } .rise { fill: #f6c744 }
  .fall { fill: #5aa2f0 }
}
"""


def box(x: float, y: float, wide: float, high: float, style: str) -> str:
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{high:.1f}" class="{style}"/>'


def draw_text(x: float, y: float, text: str, style: str = "", anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{style}" text-anchor="{anchor}">{escape(text)}</text>'


def strip(y: float, chips: NDArray[np.uint8]) -> list[str]:
    """Chips of one cluster."""
    looks = [("dark", "lit")[chip] for chip in chips.tolist()]
    return [box(LEFT + CHIP * i, y, CHIP - 0.8, HIGH - 1, style) for i, style in enumerate(looks)]


def draw_edges(y: float, chips: NDArray[np.uint8]) -> list[str]:
    """What a pixel sees of chips: brighter up, darker down."""
    parts = [f'<path class="line" d="M{LEFT} {y}h{CHIP * len(chips)}"/>']
    for i, edge in enumerate(edges_of_chips(chips).tolist(), 1):
        if edge:
            top = y - 12 if edge > 0 else y
            parts.append(box(LEFT + CHIP * i, top, 4, 12, "rise" if edge > 0 else "fall"))
    return parts


def drawing() -> str:
    """The whole drawing."""
    link = load_link()
    form = link.packet
    symbols = evlcp.compose(link, text="Road works", sequence=0)[0]
    shown = form.frame_start_chip(1) + form.pilot_chips
    chips = packet_chips(symbols, link.codebook)[:shown].T
    parts = []
    for k, row in enumerate(chips):
        parts += strip(TOP + HIGH * k, row)
    bottom = TOP + HIGH * len(chips)
    parts += [
        draw_text(LEFT - 10, TOP + 9, "cluster 0", anchor="end"),
        draw_text(LEFT - 10, bottom - 2, f"cluster {len(chips) - 1}", anchor="end"),
        draw_text(LEFT - 10, bottom + 32, "a pixel of 0", anchor="end"),
        *draw_edges(bottom + 28, chips[0]),
    ]
    starts = (0, form.preamble_chips, form.preamble_chips + form.pilot_chips, form.frame_start_chip(1), shown)
    names = (
        ("preamble", "finds time: all alike"),
        ("pilot", "which cluster"),
        ("info segment", "what it says"),
        ("next pilot", "..."),
    )
    for (name, what), a, b in zip(names, starts[:-1], starts[1:], strict=True):
        x = LEFT + CHIP * a
        parts += [
            f'<path class="line" d="M{x} {TOP - 30}V{bottom + 44}"/>',
            draw_text(x + 5, TOP - 18, name, "big"),
            draw_text(x + 5, TOP - 5, f"{b - a} chips, {what}"),
        ]
    y = bottom + 76
    parts.append(
        draw_text(LEFT, y - 8, "One info segment in other codes, and the edges that a pixel sees", "big")
    )
    for name, what, overrides in OTHERS:
        codewords = load_link(overrides=list(overrides)).codebook.codewords
        word = codewords[27 % len(codewords)]
        parts += [draw_text(LEFT - 10, y + 9, name, "big", "end"), *strip(y, word), *draw_edges(y + 29, word)]
        parts.append(draw_text(LEFT + CHIP * len(word) + 12, y + 9, f"{what}, {len(word)} chips"))
        y += 58
    width = LEFT + CHIP * shown + 20
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {y}" role="img">'
    return "\n".join([head, f"<title>A packet in time</title><style>{STYLE}</style>", *parts, "</svg>\n"])


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(drawing(), encoding="utf-8")
