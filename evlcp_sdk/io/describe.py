"""Summarize a recording without decoding its light, and check that it is of the link's sensor."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events

RATE_WINDOW_US = 10_000
"""The peak rate is the most events in a window of this length on a fixed grid."""


@dataclass
class Span:
    """The time of a stream: first and last event, and the duration, which grows where the clock restarts."""

    first_us: int | None = None
    last_us: int | None = None
    duration_us: int = 0

    def add(self, events: Events) -> None:
        """Add the next events, one or more."""
        start_us, end_us = int(events.t_us[0]), int(events.t_us[-1])
        if self.first_us is None or self.last_us is None:
            self.first_us = self.last_us = start_us
        self.duration_us += max(start_us - self.last_us, 0)
        # They end before their start only where the clock restarts in them.
        is_rising = end_us >= start_us
        self.duration_us += end_us - start_us if is_rising else int(np.diff(events.t_us).clip(0).sum())
        self.last_us = end_us


def summarize_source(source: EventSource, name: str, span: Span) -> dict[str, Any]:
    """Return the file, sensor, time and event rate of a source that was read, as JSON values."""
    duration_s = span.duration_us * 1e-6
    return {
        "path": name,
        "format": source.format,
        "bytes": source.size_bytes,
        "width": source.width,
        "height": source.height,
        "first_us": span.first_us,
        "last_us": span.last_us,
        "duration_s": round(duration_s, 6),
        "events_per_s": round(source.counts["events"] / duration_s) if duration_s else None,
        "counts": dict(source.counts),
    }


def describe_source(source: EventSource, name: str) -> dict[str, Any]:
    """Read a source called `name` to its end, in constant memory; return what it holds as JSON values.

    The source is not closed.

    Raises:
        InputError: It cannot be read on.
    """
    span, positive = Span(), 0
    window, in_window, peak = -1, 0, 0
    edges = np.zeros((256, 2), np.int64)
    for events, triggers in source.stream():
        kinds = triggers.channel.astype(np.int64) * 2 + (triggers.value != 0)
        edges += np.bincount(kinds, minlength=edges.size).reshape(edges.shape)
        if not len(events):
            continue
        span.add(events)
        positive += int(events.p.sum(dtype=np.int64))
        windows, counts = np.unique(events.t_us // RATE_WINDOW_US, return_counts=True)
        for w, n in zip(windows.tolist(), counts.tolist(), strict=True):
            in_window = in_window + n if w == window else n
            window, peak = w, max(peak, in_window)
    total = source.counts["events"]
    return summarize_source(source, name, span) | {
        "header": dict(source.header),
        "peak_events_per_s": round(peak * 1e6 / RATE_WINDOW_US),
        "positive_share": round(positive / total, 4) if total else None,
        "triggers": [
            {"channel": channel, "edge": ("falling", "rising")[value], "count": int(edges[channel, value])}
            for channel, value in np.argwhere(edges).tolist()
        ],
        "losses": {kind: asdict(loss) for kind, loss in source.losses.items()},
        "anomalies": [str(loss) for loss in source.losses.values()],
    }


def check_sensor(source: EventSource, url: object, camera: CameraModel) -> None:
    """Check that a recording called `url` has the size of the link's camera, or states none.

    Raises:
        ConfigError: The sizes differ.
    """
    size = (source.width, source.height)
    if None not in size and size != (camera.width, camera.height):
        raise ConfigError(
            f"{url}: recorded with {size[0]} x {size[1]} pixels, but the link's camera has"
            f" {camera.width} x {camera.height}; set camera.width, camera.height and camera.pitch_um"
        )
