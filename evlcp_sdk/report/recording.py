"""Charts of a recording, for its page and for figures beside it: frames, and positions, over time."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.navigator import Settled
from evlcp_sdk.report.colours import transmitter_colour
from evlcp_sdk.report.plots import DASHES, INK, Plot, choose_ellipse_scale, ellipse_points
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Events, Fix, Frame, Packet, sigmas

_MAX_TRANSMITTERS, _MAX_FRAMES, _MAX_POSITIONS = 6, 512, 1024
_MAX_ROWS = 40
_MAX_ELLIPSES = 40
_FIX = "#56b4e9"

T = TypeVar("T")


class EvenSample(Generic[T]):
    """Keeps at most `limit` values of a stream, an even number, evenly spread: all, then every second, ...

    >>> kept = EvenSample(4)
    >>> for i in range(10):
    ...     kept.add(i)
    >>> list(kept)
    [0, 4, 8]
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._every = 1
        self._seen = 0
        self._values: list[T] = []

    def add(self, value: T) -> None:
        """Process the next value of the stream."""
        if self._seen % self._every == 0:
            if len(self._values) == self._limit:
                self._values = self._values[::2]
                self._every *= 2
            self._values.append(value)
        self._seen += 1

    def __iter__(self) -> Iterator[T]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


@dataclass(eq=False)
class TransmitterFrames:
    """The kept frames of a transmitter.

    Attributes:
        link: Name of its link, if there are several.
        echo_of: The transmitter that it is a reflection of, by the newest packet.
        frames: A share of its frames, for the charts.
        first: The first ones, for the table.
        count: Number of all.
    """

    link: str
    echo_of: int | None = None
    frames: EvenSample[Frame] = field(default_factory=lambda: EvenSample(_MAX_FRAMES))
    first: list[Frame] = field(default_factory=list)
    count: int = 0


class ChartSink(Sink):
    """Keeps the data of charts of a recording, a bounded share of it: first transmitters, positions.

    Attributes:
        first_us: The recording's first event, camera clock, us; None before.
        transmitters: The frames of each transmitter, by its number.
        track: The positions.
    """

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self.first_us: int | None = None
        self.transmitters: dict[int, TransmitterFrames] = {}
        self.track = EvenSample[Settled](_MAX_POSITIONS)

    def events(self, events: Events) -> None:
        """Store the recording's start."""
        if self.first_us is None and len(events):
            self.first_us = int(events.t_us[0])

    def packet(self, packet: Packet) -> None:
        """Keep frames."""
        number = packet.transmitter
        if packet.frames and (number in self.transmitters or len(self.transmitters) < _MAX_TRANSMITTERS):
            kept = self.transmitters.setdefault(number, TransmitterFrames(packet.link))
            kept.echo_of = packet.echo_of
            kept.first += packet.frames[: _MAX_ROWS - len(kept.first)]
            kept.count += len(packet.frames)
            for frame in packet.frames:
                kept.frames.add(frame)

    def settle(self, settled: Sequence[Settled]) -> None:
        """Keep places."""
        for one in settled:
            self.track.add(one)

    def frames(self) -> dict[int, tuple[str, list[Frame]]]:
        """Name of each transmitter and its frames to show, in order, by its number."""
        return {
            number: (
                name_transmitter(number, kept.echo_of, kept.link),
                sorted(kept.frames, key=lambda frame: frame.t_us),
            )
            for number, kept in sorted(self.transmitters.items())
        }


@dataclass(frozen=True)
class TimeAxis:
    """Time axis of charts: from `zero_us` on the camera's clock on, in units of `step_ms`."""

    name: str
    zero_us: float
    step_ms: float

    def ms(self, t_us: float) -> float:
        """Time since its beginning, ms."""
        return (t_us - self.zero_us) * 1e-3

    def times_of(self, items: Iterable[Frame | Fix]) -> NDArray[np.float64]:
        """The times of frames or fixes, in its unit, float64 (n,)."""
        return np.array([self.ms(item.t_us) for item in items]) / self.step_ms


def seconds_axis(zero_us: float) -> TimeAxis:
    """A time axis in seconds."""
    return TimeAxis("s since the first event", zero_us, 1000.0)


def name_transmitter(number: int, echo_of: int | None, link: str = "") -> str:
    """Name a transmitter, with its link, and the transmitter that it is a reflection of."""
    who = f"transmitter {number}" + (f" ({link})" if link else "")
    return who + ("" if echo_of is None else f", reflection of {echo_of}")


def plot_distances(number: int, who: str, frames: Sequence[Frame], axis: TimeAxis) -> list[Plot]:
    """Distance of a transmitter with its one-sigma band, and deviations from neighbours, over time.

    None where no frame has a distance.
    """
    frames = [frame for frame in frames if math.isfinite(frame.range.distance_m)]
    if not frames:
        return []
    colour, name = transmitter_colour(number), f"{who}, with one sigma"
    t = axis.times_of(frames)
    depth = np.array([frame.range.distance_m for frame in frames])
    sigma = np.array([frame.range.sigma_m for frame in frames])
    labels = label_frames(who, frames, axis)
    distance = Plot(f"distance-{number}", axis.name, "distance, m", f"{who}, {len(frames)} distances")
    distance.add_dots(t, depth, colour, name, labels)
    distance.add_band(t, depth - sigma, depth + sigma, colour, name)
    filtered = [math.nan if f.filtered is None else f.filtered.distance_m for f in frames]
    if np.isfinite(filtered).any():
        distance.add_line(t, filtered, colour, f"{who}, filtered")
    deviation = Plot(f"off-{number}", axis.name, "off its neighbours, m", f"{who}, off its neighbours")
    deviation.add_dots(
        t, neighbour_residuals(t, depth), colour, "off a line through eleven frames, beside one sigma", labels
    )
    deviation.add_band(t, -sigma, sigma, colour, "off a line through eleven frames, beside one sigma")
    return [distance, deviation]


def plot_quality(frames: Mapping[int, tuple[str, Sequence[Frame]]], axis: TimeAxis) -> Plot:
    """Quality of the frames of each transmitter over time; `frames` are by number, with the name."""
    quality = Plot("quality", axis.name, "quality", "quality", y_limits=(-0.03, 1.06))
    for number, (who, shown) in frames.items():
        values = [frame.soft.quality for frame in shown]
        labels = label_frames(who, shown, axis)
        quality.add_dots(axis.times_of(shown), values, transmitter_colour(number), who, labels)
    return quality


def label_frames(who: str, frames: Iterable[Frame], axis: TimeAxis) -> list[str]:
    """Texts of frames for the pointer."""
    labels = []
    for frame in frames:
        depth = frame.range
        lines = [who, f"packet {frame.packet}, frame {frame.frame}, {axis.ms(frame.t_us):.1f} ms"]
        if math.isfinite(depth.distance_m):
            lines.append(f"{depth.distance_m:.4f} ± {depth.sigma_m:.4f} m")
        labels.append("\n".join([*lines, f"quality {frame.soft.quality:.4f}"]))
    return labels


def plot_positions(
    points: Sequence[Settled], bars_enu_m: Mapping[int, NDArray[np.float64]], axis: TimeAxis
) -> list[Plot]:
    """Fixes, track and bars in local metres; height, sigmas, protection levels over time."""
    fixes = [point.fix for point in points]
    labels = []
    for fix in fixes:
        (e, n, u), (se, sn, su) = fix.enu_m.tolist(), sigmas(fix.covariance_m2)
        labels.append(
            f"{axis.ms(fix.t_us):.1f} ms, {fix.source}\neast {e:z.3f} ± {se:.2g} m"
            f"\nnorth {n:z.3f} ± {sn:.2g} m\nup {u:z.3f} ± {su:.2g} m"
        )
    plots = [*_plot_maps(points, labels, bars_enu_m), *(_plot_times(points, labels, axis) if points else ())]
    return [plot for plot in plots if not plot.is_empty]


def _track_lines(points: Sequence[Settled]) -> list[tuple[NDArray[np.float64], str, str]]:
    """The track as filtered and as smoothed, m, float64 (n, 3), with colour and name."""
    return [
        (np.array([point.filtered.enu_m for point in points]), "#009e73", "filtered"),
        (np.array([point.smoothed.enu_m for point in points]), "#d55e00", "smoothed"),
    ]


def _plot_maps(
    points: Sequence[Settled], labels: Sequence[str], bars_enu_m: Mapping[int, NDArray[np.float64]]
) -> list[Plot]:
    plan = Plot("map", "east, m", "north, m", "bars and track", aspect=4 / 3)
    close = Plot("track", "east, m", "north, m", "the track alone", aspect=4 / 3)
    if points:
        fixes = [point.fix for point in points]
        fixed = np.array([fix.enu_m for fix in fixes])
        selected = fixes[:: -(-len(fixes) // _MAX_ELLIPSES)]
        scale = choose_ellipse_scale([fix.covariance_m2 for fix in selected], fixed)
        name = "95 % ellipse" + (f", {scale} times as large" if scale > 1 else "")
        for fix in selected:
            ring = ellipse_points(fix.enu_m[:2], fix.covariance_m2[:2, :2] * scale**2, 0.95)
            close.add_line(ring[:, 0], ring[:, 1], "#999999", name, kind="ring")
        for plot in (plan, close):
            for line, colour, name in _track_lines(points):
                plot.add_line(line[:, 0], line[:, 1], colour, name)
            plot.add_dots(fixed[:, 0], fixed[:, 1], _FIX, "fix", labels)
    for number, enu in sorted(bars_enu_m.items()):
        bar_name = f"bar {number}"
        east, north, up = enu.tolist()
        place = f"{bar_name}\neast {east:z.3f} m\nnorth {north:z.3f} m\nup {up:z.3f} m"
        plan.add_dots([east], [north], INK, "bar", [place])
        plan.add_name(east, north, bar_name)
    return [plan, close]


def _plot_times(points: Sequence[Settled], labels: Sequence[str], axis: TimeAxis) -> list[Plot]:
    fixes = [point.fix for point in points]
    t = axis.times_of(fixes)
    up = np.array([fix.enu_m[2] for fix in fixes])
    sigma = np.array([sigmas(fix.covariance_m2) for fix in fixes])
    height = Plot("height", axis.name, "up, m", "height")
    for line, colour, name in _track_lines(points):
        height.add_line(t, line[:, 2], colour, name)
    height.add_dots(t, up, _FIX, "fix, with one sigma", labels)
    height.add_band(t, up - sigma[:, 2], up + sigma[:, 2], _FIX, "fix, with one sigma")
    spread = Plot("spread", axis.name, "sigma, m", "sigmas")
    # GNSS has far larger sigmas than bars.
    sigma[[fix.source != "bars" for fix in fixes]] = math.nan
    for i, name in enumerate(("east", "north", "up")):
        spread.add_dots(t, sigma[:, i], transmitter_colour(i), name, labels)
    protection = Plot("protection", axis.name, "protection, m", "protection levels", from_zero=True)
    protection.add_line(t, [fix.hpl_m for fix in fixes], INK, "horizontal level")
    protection.add_line(t, [fix.vpl_m for fix in fixes], INK, "vertical level", DASHES[2])
    excluding = [at for at, fix in zip(t, fixes, strict=True) if fix.excluded]
    if excluding:
        protection.add_dots(excluding, np.zeros(len(excluding)), "#d55e00", "a part left out")
    return [height, spread, protection]


def neighbour_residuals(t_s: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Deviation of each value from a line through itself and its neighbours in time, float64 (n,)."""
    n = len(values)
    count = min(_NEIGHBOURS, n)
    if count < 3:
        return np.zeros(n)
    first = np.clip(np.arange(n) - count // 2, 0, n - count)
    neighbours = first[:, None] + np.arange(count)
    t, v = t_s[neighbours], values[neighbours]
    middle_t, middle_v = t.mean(1), v.mean(1)
    dt = t - middle_t[:, None]
    slope = (dt * v).sum(1) / np.maximum((dt**2).sum(1), 1e-30)
    line = middle_v + slope * (t_s - middle_t)
    # The value's own weight in the line makes its residual smaller.
    weight = 1 / count + (t_s - middle_t) ** 2 / np.maximum((dt**2).sum(1), 1e-30)
    return np.asarray((values - line) / np.sqrt(np.maximum(1 - weight, 1 / count)))


_NEIGHBOURS = 11
