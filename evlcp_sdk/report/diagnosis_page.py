"""The self-contained page of a diagnosis: stages, two maps of the image, blinking sources, trials."""

import base64
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.diagnose import Diagnosis
from evlcp_sdk.report.pages import render_page

_MAX_SOURCES = 40

_MARKS = {
    "pass": ("yes", "ok"),
    "doubt": ("no", "doubt"),
    "fail": ("no", "fails"),
    "note": ("note", "-"),
    "skip": ("note", "-"),
}
"""Style and text of each verdict."""


def render_diagnosis(diagnosis: Diagnosis) -> str:
    """Render the page as HTML."""
    name = Path(diagnosis.recording).name
    height, width = (n * diagnosis.cell_px for n in diagnosis.frequency_hz.shape)
    shown = diagnosis.sources[:_MAX_SOURCES]
    sources = [(n, *one.table_cells().values(), f"{one.strength:.2f}") for n, one in enumerate(shown, 1)]
    trials = [
        (
            one.options(),
            f"{one.frames} of {one.frames + one.rejected}",
            f"{one.quality:.2f}",
            "yes" if one.fits else "no",
        )
        for one in diagnosis.trials
    ]
    return render_page(
        "diagnosis.html",
        f"{name}: diagnosis",
        name=name,
        diagnosis=diagnosis,
        marks=_MARKS,
        steps=[one for one in diagnosis.checks if one.next_step and one.verdict in ("doubt", "fail")],
        events_png=_encode_png(_draw_events(diagnosis.events_map)),
        frequency_png=_encode_png(_draw_frequencies(diagnosis.frequency_hz)),
        width=width,
        height=height,
        most=_MAX_SOURCES,
        heads=["", *shown[0].table_cells(), "certainty"] if shown else [],
        sources=sources,
        trials=trials,
    )


def _encode_png(image: NDArray[np.uint8]) -> str:
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, image, format="png")
    return base64.b64encode(buffer.getvalue()).decode()


def _draw_events(events: NDArray[np.int64]) -> NDArray[np.uint8]:
    total = events.sum(-1)
    level = np.log1p(total) / max(float(np.log1p(total.max(initial=1))), 1e-9)
    share = (events[..., 1] + 1) / (total + 2)
    red = level * np.clip(2 * share, 0.3, 1)
    blue = level * np.clip(2 - 2 * share, 0.3, 1)
    green = level * np.minimum(red, blue) / np.maximum(np.maximum(red, blue), 1e-9)
    return np.asarray(255 * np.stack([red, green, blue], -1), np.uint8)


def _draw_frequencies(frequency_hz: NDArray[np.float64]) -> NDArray[np.uint8]:
    from matplotlib import colormaps

    position = np.log(np.nan_to_num(frequency_hz, nan=60.0) / 60.0) / np.log(25_000 / 60.0)
    image = colormaps["turbo"](np.clip(0.08 + 0.9 * position, 0, 1))[..., :3]
    image[np.isnan(frequency_hz)] = 0.07
    return np.asarray(255 * image, np.uint8)
