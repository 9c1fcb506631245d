"""Ideal recordings: a bar whose every pixel sends a few events after each edge."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.values import Events


@dataclass(frozen=True, eq=False)
class IdealBar:
    """A transmitter in the image that sends these symbols; its centre moves on a circle.

    Attributes:
        symbols: Its symbols, int64 (packets, frames, clusters).
        x_px: Column of its centre, px.
        y_px: Row of its centre, px.
        cluster_px: Spacing of its clusters in the image, px.
        width_px: Its width, px.
        ppm: How much faster than nominal its clock runs.
        start_us: When its first packet starts, us.
        shake_px: Radius of the circle, px.
        shake_hz: Turns a second.
    """

    symbols: NDArray[np.int64]
    x_px: float = 400.3
    y_px: float = 350.7
    cluster_px: float = 8.0
    width_px: int = 4
    ppm: float = 0.0
    start_us: float = 5000.0
    shake_px: float = 0.0
    shake_hz: float = 10.0

    def centre(self, t_us: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the column and row of the centre at some times, px."""
        phase = 2 * np.pi * self.shake_hz * t_us * 1e-6
        return self.x_px + self.shake_px * np.sin(phase), self.y_px + self.shake_px * np.cos(phase)


def random_symbols(link: Link, packets: int, seed: int = 0) -> NDArray[np.int64]:
    """Return random symbols of a link that carry bits, int64 (packets, frames, clusters)."""
    shape = (packets, link.packet.frames, link.codebook.clusters)
    return np.random.default_rng(seed).integers(0, link.codebook.data_symbols, shape)


def bar_in_sight(link: Link, symbols: NDArray[np.int64], **how: Any) -> IdealBar:
    """Return a bar that is away from the edges of the link's sensor; `how` has more of its attributes."""
    x_px, y_px = min(IdealBar.x_px, link.camera.width / 2), min(IdealBar.y_px, link.camera.height / 2)
    return replace(IdealBar(symbols, x_px, y_px), **how)


def ideal_events(
    link: Link,
    bar: IdealBar,
    *,
    seed: int = 0,
    events_per_edge: int = 3,
    delay_on_us: float = 20.0,
    delay_off_us: float = 40.0,
    missing: float = 0.1,
    t0_us: int = 0,
) -> Events:
    """Return the events of an ideal sensor: some per pixel and edge, delayed, jittered, some missing.

    Three of an edge are spread over a quarter of a chip, however long that is.

    Args:
        link: The link, with codebook, packet format and the size of the sensor.
        bar: The transmitter.
        seed: Seed of jitter and missing events.
        events_per_edge: Events that a pixel sends for each edge.
        delay_on_us: From a rising edge to its first event, us.
        delay_off_us: From a falling edge to its first event, us.
        missing: Share of the events that are missing.
        t0_us: Time of the camera's clock at the start of the recording, us.
    """
    rng = np.random.default_rng(seed)
    chips = np.concatenate([packet_chips(s, link.codebook, link.packet.pilot_every) for s in bar.symbols])
    # The bar is dark before the first packet, and idle after the last.
    rest = link.algorithm("framing").rest() or 0
    edges = np.diff(chips.astype(np.int64), axis=0, prepend=0, append=rest)
    chip_us = link.packet.chip_us / (1 + bar.ppm * 1e-6)
    clusters = link.codebook.clusters
    rows = round(clusters * bar.cluster_px)
    of_row = np.minimum((np.arange(rows) + 0.5) / bar.cluster_px, clusters - 1).astype(np.int64)
    when, row = np.nonzero(edges[:, of_row])
    sign = edges[when, of_row[row]]
    count = bar.width_px * events_per_edge
    when, row, sign = (np.repeat(v, count) for v in (when, row, sign))
    column = np.tile(np.arange(count) % bar.width_px, len(when) // count)
    order = np.tile(np.arange(count) // bar.width_px, len(when) // count)
    # The end of the last packet is drawn last, so that the packets do not depend on what follows them.
    many = int(np.count_nonzero(when < len(chips)))
    draws = [(rng.normal(0, 0.04 * link.packet.chip_us, n), rng.random(n)) for n in (many, len(when) - many)]
    jitter_us, chance = (np.concatenate(one) for one in zip(*draws, strict=True))
    t = bar.start_us + when * chip_us
    t = t + np.where(sign > 0, delay_on_us, delay_off_us) + 0.12 * link.packet.chip_us * order + jitter_us
    x, y = bar.centre(t)
    u = np.floor(x - bar.width_px / 2 + 0.5 + column)
    v = np.floor(y - rows / 2 + 0.5 + row)
    keep = (chance >= missing) & (t >= 0)
    keep &= (u >= 0) & (v >= 0) & (u < link.camera.width) & (v < link.camera.height)
    t_us = np.floor(t[keep]).astype(np.int64) + t0_us
    first = np.argsort(t_us, kind="stable")
    seen = Events.of(t_us[first], u[keep][first], v[keep][first], (sign[keep] > 0)[first])
    # The recording goes on for ten chips: its last event is noise in a corner.
    end_us = bar.start_us + (len(chips) + 10) * chip_us + t0_us
    return Events.concat([seen, Events.of([end_us], [0], [0], [1])])


def merge_events(*parts: Events) -> Events:
    """Return all events in order of time."""
    every = Events.concat(parts)
    return every[np.argsort(every.t_us, kind="stable")]
