"""The colours of transmitters and clusters, the same in figures, films, reports and the live view."""

import colorsys

import numpy as np
from numpy.typing import NDArray

TRANSMITTER_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's colours, which colour-blind readers can distinguish, too."""


def transmitter_colour(number: int) -> str:
    """Colour of a transmitter, the same in every figure."""
    return TRANSMITTER_COLOURS[number % len(TRANSMITTER_COLOURS)]


def cluster_colours(clusters: int) -> NDArray[np.float64]:
    """Colours of the clusters, float64 (clusters, 3): hue along the bar, neighbours bright and dark."""
    hues = np.arange(clusters) / max(clusters, 1) * 0.85
    return np.array([colorsys.hsv_to_rgb(h, 0.95, (0.95, 0.65)[k % 2]) for k, h in enumerate(hues)])


def cluster_hex(clusters: int) -> list[str]:
    """The same as hex strings for pages, e.g. `#f20d0d`."""
    return ["#" + "".join(f"{round(255 * v):02x}" for v in one) for one in cluster_colours(clusters).tolist()]
