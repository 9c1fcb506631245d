"""One self-contained page of a diagnosis: stages, two maps of the picture, what blinks, what was tried."""

import base64
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.diagnose import Diagnosis
from evlcp_sdk.diagnosis.light import LightSource
from evlcp_sdk.report.markup import Markup, details, document, table

__all__ = ["page"]

_MARKS = {"pass": "ok", "doubt": "doubt", "fail": "fails", "skip": "-"}
_CLASSES = {"pass": "yes", "doubt": "no", "fail": "no", "skip": "note"}

_STYLE = Markup(
    "<style>.map { position: relative; background: #111 }"
    " .map img { width: 100%; display: block; image-rendering: pixelated }"
    " .map svg { position: absolute; left: 0; top: 0; width: 100%; height: 100% }"
    " .said { white-space: normal; text-align: left }</style>"
)


def page(diagnosis: Diagnosis) -> str:
    """The page's HTML."""
    name = Path(diagnosis.recording).name
    height, width = (n * diagnosis.cell_px for n in diagnosis.frequency_hz.shape)
    boxes = _boxes(diagnosis.sources, width, height)
    body = [
        _STYLE,
        Markup("<h1>{}</h1><p>{}</p>").format(name, diagnosis.headline),
        _stages(diagnosis),
        _steps(diagnosis),
        Markup("<h2>Where events are</h2>"),
        _map(_events_image(diagnosis.events_map), boxes, "events of each cell, brighter for more"),
        Markup('<p class="note">{}</p>').format(
            f"Events of cells of {diagnosis.cell_px} px over {diagnosis.duration_s:.3f} s, brighter for more"
            " (logarithm); red: mostly positive, blue: mostly negative."
        ),
        Markup("<h2>What blinks how fast</h2>"),
        _map(_frequency_image(diagnosis.frequency_hz), boxes, "frequency of each cell by colour"),
        Markup('<p class="note">{}</p>').format(
            "From blue, 60 Hz, over green, 1 kHz, to red, 25 kHz; by the times between the rises of pixels."
            " Frames are the sources below."
        ),
        _sources(diagnosis.sources),
    ]
    if diagnosis.trials:
        body.append(_trials(diagnosis))
    if diagnosis.warnings:
        body.append(
            Markup("<h2>Warnings of receive</h2><ul>{}</ul>").format(_items(map(str, diagnosis.warnings)))
        )
    body.append(details("counts of the receiver", diagnosis.counts))
    return document(f"{name}: diagnosis", body)


def _stages(diagnosis: Diagnosis) -> Markup:
    rows = []
    for one in diagnosis.checks:
        mark = Markup('<span class="{}">{}</span>').format(_CLASSES[one.verdict], _MARKS[one.verdict])
        rows.append(
            Markup('<tr><td>{}</td><td>{}</td><td class="said">{}</td></tr>').format(
                one.stage, mark, one.said
            )
        )
    lines = Markup("\n").join(rows)
    return Markup(
        '<h2>Stages</h2><div class="wide"><table>'
        '<tr><th>stage</th><th></th><th class="said">what says so</th></tr>{}</table></div>'
    ).format(lines)


def _steps(diagnosis: Diagnosis) -> Markup:
    steps = [
        f"{one.stage}: {one.next_step}" for one in diagnosis.checks if one.next_step and one.verdict != "skip"
    ]
    if not steps:
        return Markup("")
    return Markup("<h2>Next steps</h2><ul>{}</ul>").format(_items(steps))


def _items(texts: Iterable[str]) -> Markup:
    return Markup("").join(Markup("<li>{}</li>").format(text) for text in texts)


def _map(image: NDArray[np.uint8], boxes: Markup, what: str) -> Markup:
    return Markup('<div class="map"><img alt="{}" src="data:image/png;base64,{}">{}</div>').format(
        what, _png(image), boxes
    )


def _png(image: NDArray[np.uint8]) -> str:
    from matplotlib.image import imsave

    held = io.BytesIO()
    imsave(held, image, format="png")
    return base64.b64encode(held.getvalue()).decode()


def _events_image(events: NDArray[np.int64]) -> NDArray[np.uint8]:
    many = events.sum(-1)
    level = np.log1p(many) / max(float(np.log1p(many.max(initial=1))), 1e-9)
    share = (events[..., 1] + 1) / (many + 2)
    red = level * np.clip(2 * share, 0.3, 1)
    blue = level * np.clip(2 - 2 * share, 0.3, 1)
    green = level * np.minimum(red, blue) / np.maximum(np.maximum(red, blue), 1e-9)
    return np.asarray(255 * np.stack([red, green, blue], -1), np.uint8)


def _frequency_image(frequency_hz: NDArray[np.float64]) -> NDArray[np.uint8]:
    from matplotlib import colormaps

    place = np.log(np.nan_to_num(frequency_hz, nan=60.0) / 60.0) / np.log(25_000 / 60.0)
    image = colormaps["turbo"](np.clip(0.08 + 0.9 * place, 0, 1))[..., :3]
    image[np.isnan(frequency_hz)] = 0.07
    return np.asarray(255 * image, np.uint8)


def _boxes(sources: tuple[LightSource, ...], width: int, height: int) -> Markup:
    parts = []
    for number, one in enumerate(sources[:40], 1):
        left, top, right, bottom = one.box_px
        parts.append(
            Markup(
                '<rect x="{}" y="{}" width="{}" height="{}" fill="none" stroke="#fff" stroke-width="2"/>'
                '<text x="{}" y="{}" fill="#fff" font-size="{}">{}</text>'
            ).format(
                left, top, right - left, bottom - top, right + 4, top + height // 40, height // 28, number
            )
        )
    return Markup('<svg viewBox="0 0 {} {}" preserveAspectRatio="none">{}</svg>').format(
        width, height, Markup("").join(parts)
    )


def _sources(sources: tuple[LightSource, ...]) -> Markup:
    if not sources:
        return Markup("<p>Nothing blinks.</p>")
    rows = [
        (
            f"{number}",
            one.kind,
            f"{one.rate_hz:,.0f}",
            f"{one.strength:.2f}",
            f"{one.wide_px:.0f} x {one.high_px:.0f}" if one.wide_px else "-",
            f"{one.box_px[0]} to {one.box_px[2]}, {one.box_px[1]} to {one.box_px[3]}",
            f"{one.events:,}",
            f"{1 - one.negative_share:.0%} / {one.negative_share:.0%}",
        )
        for number, one in enumerate(sources[:40], 1)
    ]
    more = f", the first 40 of {len(sources)}" if len(sources) > 40 else ""
    head = ("", "kind", "Hz", "certainty", "size, px", "columns, rows", "events", "positive / negative")
    return Markup("<h2>Sources{}</h2>{}").format(more, table(head, rows))


def _trials(diagnosis: Diagnosis) -> Markup:
    rows = [
        (
            one.options(),
            f"{one.frames} of {one.frames + one.rejected}",
            f"{one.quality:.2f}",
            "yes" if one.fits else "no",
        )
        for one in diagnosis.trials
    ]
    head = ("with", "frames accepted", "quality", "fits")
    return Markup("<h2>Other links that were tried</h2>{}").format(table(head, rows))
