"""A film of a recording: its events in slow motion, with regions, symbols and distances drawn in."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evlcp_sdk.errors import ConfigError, InputError, import_extra
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.report.colours import cluster_hex, transmitter_colour
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Frame, Region

FilmKind = Literal["WEBP", "GIF", "MP4"]

FILM_KINDS: Mapping[str, FilmKind] = {".webp": "WEBP", ".gif": "GIF", ".mp4": "MP4"}
"""Format of a film by the suffix of its file."""

MAX_PICTURES, MAX_MEGAPIXELS = 500, 160
"""Largest number of a film's pictures, and of pixels in all of them, which are held until it is written, a
byte each."""

PICTURES_PER_S = 25
"""Frame rate of the film."""

_DARK, _ON, _OFF = np.array([16, 16, 20]), np.array([255, 205, 70]), np.array([70, 150, 255])
_INK, _DIM = (235, 235, 235), (150, 150, 150)
_MAX_SCALE = 8.0

_TEXT_PX = 13
_HEAD_PX = 20
_COLOURS = 128
_MAX_KEPT = 20_000
"""Frames, and regions, the newest, that are kept while a recording is decoded."""

_DELAY_PACKETS = 3
"""Packets after which the frames of a time are available."""


@dataclass(frozen=True)
class Film:
    """Time and area that a film shows, and its scales.

    Attributes:
        start_us: Camera clock at its start, us.
        pictures: Number of pictures.
        left, top, columns, rows: The area of the sensor.
        scale: Pixels of a picture for one of the sensor, at most 8.
        slowdown: Ratio of the time it is shown to the time it took.
    """

    start_us: float
    pictures: int
    left: int
    top: int
    columns: int
    rows: int
    scale: float
    slowdown: float

    @property
    def picture_us(self) -> float:
        """Time from a picture to the next, us."""
        return 1e6 / PICTURES_PER_S / self.slowdown

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of its pictures, with the line above."""
        width, height = (math.ceil(n * self.scale - 1e-9) for n in (self.columns, self.rows))
        return width, height + _HEAD_PX

    def to_picture(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Convert a place on the sensor to one in its pictures."""
        return (x_px + 0.5 - self.left) * self.scale, (y_px + 0.5 - self.top) * self.scale + _HEAD_PX


@dataclass(frozen=True, eq=False)
class Footage:
    """Frames and regions that are drawn over a film's events.

    Attributes:
        start_us: Camera clock at its start, us.
        first_us: The recording's first event, us.
        frames: In order of time, as the regions.
    """

    start_us: float
    first_us: float = 0.0
    frames: Sequence[Frame] = ()
    regions: Sequence[Region] = ()


def count_pictures(for_ms: float, slow: float) -> float:
    """Number of pictures of a film of some time; infinite of endless slow motion.

    >>> count_pictures(40, slow=100)
    100.0
    """
    return max(float(np.ceil(for_ms * 1e-3 * PICTURES_PER_S * slow - 1e-9)), 1.0)


def check_film(out: Path, for_ms: float, slow: float) -> FilmKind:
    """Check a film's length and file; return its kind by the file's name.

    Raises:
        ConfigError: There is no such kind, the extra for it is not installed, or it has too many pictures.
    """
    if (kind := FILM_KINDS.get(out.suffix.lower())) is None:
        raise ConfigError(f"{out}: a film is written as {' or '.join(f'NAME{end}' for end in FILM_KINDS)}")
    if kind == "MP4":
        import_extra("av", "mp4", str(out))
    pictures = count_pictures(for_ms, slow)
    if not pictures <= MAX_PICTURES:
        raise ConfigError(
            f"{for_ms:g} ms at 1/{slow:g} would be {pictures:g} pictures, at most {MAX_PICTURES}: show less,"
            " or faster"
        )
    return kind


class _RegionCollector:
    """Keeps the newest regions that a receiver follows."""

    def __init__(self) -> None:
        self.regions: deque[Region] = deque(maxlen=_MAX_KEPT)

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep a region."""
        if stage == "regions":
            self.regions.append(value)


def gather_footage(
    source: EventSource,
    name: str,
    links: Mapping[str, Link],
    registry: Registry,
    from_ms: float | None,
    for_us: float,
    advance: Callable[[int, int | None], None] = lambda _done, _of: None,
) -> Footage:
    """Decode a recording until the end of a film.

    The film starts `from_ms` after the first event; without that at the first decoded frame, or at the start
    if there is none. Hooks of the registry are called for the receiver's stages.

    Raises:
        InputError: The recording has nothing there.
    """
    probe, frames = _RegionCollector(), deque[Frame](maxlen=_MAX_KEPT)
    first_us = last_us = start_us = math.nan
    # With several links, packets of one wait for the others.
    delay_us = _DELAY_PACKETS * min(len(links), 2) * max(one.packet.packet_us for one in links.values())
    with registry.add_temporarily(probe):
        receiver = Receiver([*links.values()], registry.hook)
        for events in source.chunks():
            last_us = float(events.t_us[-1])
            if math.isnan(first_us):
                first_us = float(events.t_us[0])
                start_us = math.nan if from_ms is None else first_us + from_ms * 1e3
            frames.extend(frame for packet in receiver.feed(events) for frame in packet.frames)
            if from_ms is None:
                start_us = min((frame.t_us for frame in frames), default=math.nan)
            advance(source.position_bytes, source.size_bytes)
            if last_us > start_us + for_us + delay_us:
                break
        frames.extend(frame for packet in receiver.close() for frame in packet.frames)
    if math.isnan(first_us):
        raise InputError(f"{name}: no events")
    if from_ms is None:
        start_us = min((frame.t_us for frame in frames), default=first_us)
    if start_us > last_us:
        raise InputError(
            f"{name}: ends {(last_us - first_us) * 1e-3:.1f} ms after its first event, nothing to show"
            f" from {from_ms:g} ms on"
        )

    # The frame before the first picture is still shown in it.
    shown = [one for one in frames if abs(one.t_us - start_us) <= for_us]
    regions = [one for one in probe.regions if start_us - 1e4 <= one.t_us <= start_us + for_us]
    return Footage(
        start_us, first_us, sorted(shown, key=lambda one: one.t_us), sorted(regions, key=lambda one: one.t_us)
    )


def plan_film(
    footage: Footage, for_us: float, slow: float, camera: CameraModel, longest_px: int, *, whole: bool = False
) -> Film:
    """Plan the area: the bars that are read, with a margin; without any, what blinks, or all.

    `longest_px` is the longest side of a picture without the line above.

    Raises:
        ConfigError: It would have too many pixels.
    """
    left, top, right, bottom = 0, 0, camera.width, camera.height
    boxes = [*map(_box_of_frame, footage.frames)] or [*map(_box_of_region, footage.regions)]
    if boxes and not whole:
        corners = np.array(boxes)
        low, high = corners[:, 0].min(0), corners[:, 1].max(0)
        middle, size = (low + high) / 2, high - low
        # With room for symbols beside a bar and its distance above.
        columns, rows = size + 2 * max(8.0, 0.15 * float(size.max()))
        columns = max(columns, 0.7 * rows, 60.0)
        rows = max(rows, 0.4 * columns)
        left, right = _clamp_range(float(middle[0]), float(columns), camera.width)
        top, bottom = _clamp_range(float(middle[1]), float(rows), camera.height)
    scale = min(longest_px / max(right - left, bottom - top), _MAX_SCALE)
    pictures = int(count_pictures(for_us * 1e-3, slow))
    film = Film(footage.start_us, pictures, left, top, right - left, bottom - top, scale, slow)
    width, height = film.size_px
    if (megapixels := pictures * width * height * 1e-6) > MAX_MEGAPIXELS:
        raise ConfigError(
            f"{pictures} pictures of {width} x {height} px are {megapixels:.0f} megapixels, at most"
            f" {MAX_MEGAPIXELS}: smaller, shorter, or faster"
        )
    return film


def draw_film(
    film: Film, events: Iterable[Events], footage: Footage, links: Mapping[str, Link]
) -> Iterator[Image.Image]:
    """Draw the pictures one after another; reads no further than to the last one's events."""
    overlay = _Overlay(film, footage, links)
    chip_us = min(link.packet.chip_us for link in links.values())
    lit = np.zeros((2, film.rows, film.columns), np.float32)
    # Exposed for longer than a chip, blinking lights would be white.
    open_from = 1 - min(chip_us / film.picture_us, 1.0)
    # In a picture shorter than a chip, the chip's earlier events remain.
    remaining = 0.0 if open_from else 0.5 ** (film.picture_us / chip_us)
    chunks = iter(events)
    chunk = Events.empty()
    for number in range(film.pictures):
        end_us = film.start_us + (number + 1) * film.picture_us
        while True:
            time = (chunk.t_us - film.start_us) / film.picture_us - number
            _add_events(lit, chunk[(time >= open_from) & (time < 1)], film)
            if len(chunk) and chunk.t_us[-1] >= end_us:
                break
            following = next(chunks, None)
            if following is None:
                break
            chunk = following
        yield overlay.draw(number, _render_events(lit, film))
        lit *= remaining


def save_film(pictures: Sequence[Image.Image], path: Path, kind: FilmKind) -> None:
    """Save an animated picture, which repeats, or a film."""
    if kind == "MP4":
        _save_mp4(pictures, path)
        return
    first, *rest = pictures
    duration_ms = round(1000 / PICTURES_PER_S)
    options: dict[str, Any] = {"quality": 80, "method": 2} if kind == "WEBP" else {"optimize": False}
    first.save(path, kind, save_all=True, append_images=rest, duration=duration_ms, loop=0, **options)


def _save_mp4(pictures: Sequence[Image.Image], path: Path) -> None:
    """Save H.264 with 4:2:0 subsampling, which every player supports."""
    import av

    width, height = (size + size % 2 for size in pictures[0].size)
    with av.open(path, "w", format="mp4") as file:
        stream = file.add_stream("libx264", PICTURES_PER_S, options={"crf": "20", "threads": "1"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for picture in pictures:
            even = Image.new("RGB", (width, height))
            even.paste(picture)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(even), format="rgb24")))
        file.mux(stream.encode())


def _clamp_range(middle: float, size: float, most: int) -> tuple[int, int]:
    """Range of this size about a middle, shifted so that it is inside."""
    length = min(math.ceil(size), most)
    first = min(max(round(middle - length / 2), 0), most - length)
    return first, first + length


def _box_of_frame(frame: Frame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    known = frame.points_px[np.isfinite(frame.points_px).all(1)]
    points = np.concatenate([known, [[frame.x_px, frame.y_px]]])
    # Half a cluster beyond the middles of the clusters.
    margin = np.ptp(points, axis=0).max() / 2 / max(len(known) - 1, 1)
    return points.min(0) - margin, points.max(0) + margin


def _box_of_region(region: Region) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    middle, half = np.array([region.x_px, region.y_px]), np.array([region.width_px, region.height_px]) / 2
    return middle - half, middle + half


def _add_events(lit: NDArray[np.float32], events: Events, film: Film) -> None:
    x, y = events.x.astype(np.int64) - film.left, events.y.astype(np.int64) - film.top
    inside = (x >= 0) & (x < film.columns) & (y >= 0) & (y < film.rows)
    np.add.at(lit, (events.p[inside].astype(np.int64), y[inside], x[inside]), 1.0)


def _render_events(lit: NDArray[np.float32], film: Film) -> Image.Image:
    width, height = film.size_px
    height -= _HEAD_PX
    if film.scale < 1:
        # The strongest of the pixels that share one: a bar is a few columns wide.
        for axis, size in ((1, height), (2, width)):
            first = (np.arange(size) / film.scale).astype(np.int64)
            lit = np.maximum.reduceat(lit, np.minimum(first, lit.shape[axis] - 1), axis=axis)
    net, brightest = lit[1].astype(np.float64) - lit[0], lit.max(0)
    share = np.where(net == 0, 0.5, (np.sign(net) + 1) / 2)[..., None]
    light = (1 - np.exp2(-brightest))[..., None]
    colour = _DARK + (share * _ON + (1 - share) * _OFF - _DARK) * light
    picture = Image.fromarray(np.clip(colour, 0, 255).astype(np.uint8))
    return picture.resize((width, height), Image.Resampling.NEAREST)


class _Overlay:
    def __init__(self, film: Film, footage: Footage, links: Mapping[str, Link]) -> None:
        self._film, self._footage = film, footage
        self._packets = {name: link.packet for name, link in links.items()}
        self._step_us = next(iter(links.values())).regions.step_us
        most = max(link.codebook.clusters for link in links.values())
        self._colours = [_brighten(colour) for colour in cluster_hex(most)]
        self._font = ImageFont.load_default(_TEXT_PX)

    def draw(self, number: int, light: Image.Image) -> Image.Image:
        """Draw one picture, in a palette of its own."""
        film, (width, _) = self._film, self._film.size_px
        picture = Image.new("RGB", film.size_px, tuple(_DARK.tolist()))
        picture.paste(light, (0, _HEAD_PX))
        pen = ImageDraw.Draw(picture)
        t_us = film.start_us + (number + 0.5) * film.picture_us
        step_us, regions = self._step_us, self._footage.regions
        current = {r.id: r for r in regions if -1.5 * step_us < r.t_us - t_us <= step_us / 2}
        for region in current.values():
            (x0, y0), (x1, y1) = _box_of_region(region)
            corners = (*film.to_picture(x0 - 1, y0 - 1), *film.to_picture(x1 + 1, y1 + 1))
            pen.rectangle(corners, outline=(90, 90, 90))
        frames, packets = self._footage.frames, self._packets
        newest = {f.transmitter: f for f in frames if 0 <= t_us - f.t_us < packets[f.link].packet_us}
        for frame in newest.values():
            packet = packets[frame.link]
            chips = packet.frame_chips if packet.has_pilot(frame.frame) else packet.info_chips
            (left, top), (right, _) = _box_of_frame(frame)
            self._draw_name(pen, frame, film.to_picture(left, top))
            if t_us < frame.t_us + chips * packet.chip_us:
                self._draw_symbols(pen, frame, right)
        pen.rectangle((0, 0, width, _HEAD_PX - 3), fill=tuple(_DARK.tolist()))
        pen.text((4, 1), f"{t_us * 1e-3:.2f} ms", fill=_INK, font=self._font)
        pen.text((width - 4, 1), f"1/{film.slowdown:g}", fill=_DIM, font=self._font, anchor="ra")
        progress_px = (number + 1) / film.pictures * width
        pen.line((0, _HEAD_PX - 3, progress_px, _HEAD_PX - 3), fill=_DIM)
        return picture.quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)

    def _draw_name(self, pen: ImageDraw.ImageDraw, frame: Frame, corner: tuple[float, float]) -> None:
        distance = frame.range
        text = f"{frame.transmitter} ({frame.link})" if frame.link else f"{frame.transmitter}"
        if frame.echo_of is not None:
            text += f", reflection of {frame.echo_of}"
        if math.isfinite(distance.distance_m):
            text += f": {distance.distance_m:.2f} ± {distance.sigma_m:.2f} m"
        width, _ = self._film.size_px
        x = min(max(corner[0], 2), max(width - pen.textlength(text, self._font) - 4, 2))
        y = max(corner[1] - 1.6 * _TEXT_PX, _HEAD_PX)
        pen.text((x, y), text, fill=_brighten(transmitter_colour(frame.transmitter)), font=self._font)

    def _draw_symbols(self, pen: ImageDraw.ImageDraw, frame: Frame, right_px: float) -> None:
        rows = {k: y for k, (x, y) in enumerate(frame.points_px.tolist()) if math.isfinite(x + y)}
        if len(rows) < 2 or np.ptp([*rows.values()]) * self._film.scale < 0.8 * _TEXT_PX * (len(rows) - 1):
            # The symbols of a panel, or of a bar too far away, would overlap.
            return
        for k, row in rows.items():
            x, y = self._film.to_picture(right_px, row)
            symbol = int(frame.soft.symbols[k])
            text = str(symbol) if symbol >= 0 else "-"
            pen.text((x + 8, y), text, fill=self._colours[k], font=self._font, anchor="lm")


def _brighten(colour: str) -> tuple[int, ...]:
    """Brighten a colour for a dark background."""
    return tuple(90 + int(colour[i : i + 2], 16) * 165 // 255 for i in (1, 3, 5))
