"""The values that flow through the receiver: events, regions, locks, presence, symbols, ranges, frames."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk import _kernels
from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind, Message
from evlcp_sdk.air.kinds import MessageKind
from evlcp_sdk.errors import StreamError, import_extra

if TYPE_CHECKING:
    import pandas
    import pyarrow

_COLUMNS = (
    ("t_us", np.dtype(np.int64)),
    ("x", np.dtype(np.uint16)),
    ("y", np.dtype(np.uint16)),
    ("p", np.dtype(np.uint8)),
)


@dataclass(frozen=True, eq=False)
class Events:
    """Contrast-detection events in columns of equal length.

    Attributes:
        t_us: Camera clock, us, int64 (n,).
        x: Column, uint16 (n,).
        y: Row, uint16 (n,).
        p: Polarity, uint8 (n,); 1 = brighter (ON), 0 = darker (OFF).

    Raises:
        StreamError: A column has another type or length.

    >>> e = Events.of([5, 7], x=[1, 2], y=[3, 4], p=[1, 0])
    >>> len(e), e[1:].t_us.tolist()
    (2, [7])
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]

    def __post_init__(self) -> None:
        shape = self.t_us.shape
        for name, dtype in _COLUMNS:
            column = getattr(self, name)
            if column.dtype != dtype or column.shape != shape or len(shape) != 1:
                raise StreamError(
                    f"events column {name}: {column.dtype} {column.shape},"
                    f" expected {dtype} ({len(self.t_us)},)"
                )

    @classmethod
    def of(cls, t_us: Any, x: Any, y: Any, p: Any) -> Self:
        """Events from array-likes, converted to the column types."""
        return cls(
            np.ascontiguousarray(t_us, np.int64),
            np.ascontiguousarray(x, np.uint16),
            np.ascontiguousarray(y, np.uint16),
            np.ascontiguousarray(p, np.uint8),
        )

    @classmethod
    def as_is(
        cls, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8]
    ) -> "Events":
        """Events from columns that are known to be of these types and of one length."""
        events = object.__new__(Events)
        vars(events).update(t_us=t_us, x=x, y=y, p=p)
        return events

    @classmethod
    def empty(cls) -> Self:
        """No events."""
        return cls.of([], [], [], [])

    @classmethod
    def concat(cls, parts: Iterable["Events"]) -> "Events":
        """All events of `parts`, in order."""
        columns = [(q.t_us, q.x, q.y, q.p) for q in parts]
        # Columns of one type and length stay so.
        return Events.as_is(*map(np.concatenate, zip(*columns, strict=True))) if columns else cls.empty()

    def to_pandas(self) -> "pandas.DataFrame":
        """The events as a table of pandas, with the columns t_us, x, y, p; copied.

        Raises:
            ConfigError: pandas is not installed.
        """
        columns = {name: getattr(self, name).copy() for name, _ in _COLUMNS}
        frame: pandas.DataFrame = import_extra("pandas", "pandas").DataFrame(columns)
        return frame

    def to_arrow(self) -> "pyarrow.Table":
        """The events as a table of Arrow, with the columns t_us, x, y, p.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        return import_extra("pyarrow", "parquet").table({name: getattr(self, name) for name, _ in _COLUMNS})

    def __repr__(self) -> str:
        return f"Events({_counted(self.t_us, 'event')})"

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, rows: Any) -> "Events":
        """The events of a slice or a mask (a view for a slice)."""
        if not isinstance(rows, slice):
            rows = np.asarray(rows)
            if rows.dtype != np.bool_ or rows.shape != self.t_us.shape:
                return Events(self.t_us[rows], self.x[rows], self.y[rows], self.p[rows])
            # By their numbers, events are taken several times as fast as by a mask.
            (rows,) = rows.nonzero()
        # Columns of one type and length stay so.
        return Events.as_is(self.t_us[rows], self.x[rows], self.y[rows], self.p[rows])


@dataclass(frozen=True, eq=False)
class Triggers:
    """Edges of the camera's external trigger inputs.

    Attributes:
        t_us: Camera clock, us, int64 (n,).
        channel: Trigger input, uint8 (n,).
        value: 1 = rising, 0 = falling, uint8 (n,).
    """

    t_us: NDArray[np.int64]
    channel: NDArray[np.uint8]
    value: NDArray[np.uint8]

    @classmethod
    def of(cls, t_us: Any, channel: Any, value: Any) -> Self:
        """Triggers from array-likes, converted to the column types."""
        return cls(np.asarray(t_us, np.int64), np.asarray(channel, np.uint8), np.asarray(value, np.uint8))

    @classmethod
    def empty(cls) -> Self:
        """No triggers."""
        return cls.of([], [], [])

    @classmethod
    def concat(cls, parts: Iterable["Triggers"]) -> Self:
        """All triggers of `parts`, in order."""
        ps = list(parts)
        if not ps:
            return cls.empty()
        return cls(*(np.concatenate([getattr(q, c) for q in ps]) for c in ("t_us", "channel", "value")))

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, rows: Any) -> "Triggers":
        """The triggers of a slice or a mask (a view for a slice)."""
        return Triggers(self.t_us[rows], self.channel[rows], self.value[rows])

    def __repr__(self) -> str:
        return f"Triggers({_counted(self.t_us, 'edge')})"


def span_us(events: Events, triggers: Triggers) -> tuple[int, int]:
    """First and last time of a piece of a stream, in which something is, camera clock, us."""
    columns = [column for column in (events.t_us, triggers.t_us) if len(column)]
    return min(int(column[0]) for column in columns), max(int(column[-1]) for column in columns)


@dataclass(frozen=True)
class Region:
    """A blinking region of the image at one time.

    Attributes:
        id: Number of the region in order of appearance, from 0.
        t_us: When it was measured, camera clock, us.
        x_px: Column of its centre, px.
        y_px: Row of its centre, px.
        width_px: Its width, px.
        height_px: Its height, px.
    """

    id: int
    t_us: float
    x_px: float
    y_px: float
    width_px: float
    height_px: float


@dataclass(frozen=True)
class SyncLock:
    """Where a transmitter's packets stand on the camera's clock.

    Attributes:
        packet_t_us: Start of a packet's first preamble chip, us, as the earliest events of rising edges show
            it; other packets lie whole periods away.
        chip_us: Length of a chip on the camera's clock, us.
        delay_on_us: What to add to a chip's start so that the window of one chip holds the positive events
            of an edge at that start best, us; negative where these events last nearly a chip.
        delay_off_us: The same for negative events.
        quality: Normalised preamble correlation, 0 to 1.
        row_us: How much later the events of a row of the bar come than those of the row above, us; the delays
            hold in its centre. The receiver measures it, synchronization leaves it 0.
        last_row_us: How much later than in its centre they come in its last row, us.
    """

    packet_t_us: float
    chip_us: float
    delay_on_us: float
    delay_off_us: float
    quality: float
    row_us: float = 0.0
    last_row_us: float = 0.0


@dataclass(frozen=True, eq=False)
class PresenceMap:
    """Probability that a grid cell shows a cluster.

    Attributes:
        probability: float32 (K, rows, columns), 0 to 1.
        grid_px: Side of a grid cell, px.
        selected: Cells that show a cluster, bool (K, rows, columns).
        pixels: Pilot correlation of the pixels in and around each cluster's selected cells, float32
            (K, height, width), 0 elsewhere; the maps that ranging needs.
        prior: The same probability by the bar's place alone, float32 (K, rows, columns); None where it is not
            known. `probability` is 0 where this is, and has no more of it in.
    """

    probability: NDArray[np.float32]
    grid_px: int
    selected: NDArray[np.bool_]
    pixels: NDArray[np.float32]
    prior: NDArray[np.float32] | None = None

    def informed(self) -> "PresenceMap":
        """With what the bar's place says taken into `probability` by Bayes' rule; as it is without a prior.

        What a cell shows tells how well it can be read, too; for a decoding that knows that by other means, a
        dim cell in its place counts in full.
        """
        prior = self.prior
        if prior is None:
            return self
        probability = np.empty_like(self.probability)
        _kernels.take_in(self.probability, prior, probability)
        return changed(self, probability=probability)

    def __repr__(self) -> str:
        clusters, rows, columns = self.selected.shape
        seen = int(self.selected.any(axis=(1, 2)).sum())
        cells = f"{columns} x {rows} cells of {self.grid_px} px"
        return f"PresenceMap({seen} of {clusters} clusters seen, {cells})"


@dataclass(frozen=True, eq=False)
class SoftSymbols:
    """What one frame carries, and how certain that is.

    Attributes:
        symbols: Most likely symbol of each cluster, int64 (K,); -1 where it is not given: the cluster was not
            seen, or the symbol is rather wrong than right.
        llr: Log-likelihood ratio ln P(bit 0) / P(bit 1) of each bit, most significant first, float32 (K, m);
            0 where a cluster was not seen.
        quality: Probability that all symbols given are right, 0 to 1: of frames with quality q, about 1 - q
            have a wrong bit. The receiver takes it from the LLRs, whatever a decoding gives here.
    """

    symbols: NDArray[np.int64]
    llr: NDArray[np.float32]
    quality: float

    def __repr__(self) -> str:
        return f"SoftSymbols({_symbols(self)}, quality {self.quality:.2f})"


@dataclass(frozen=True, eq=False)
class FrameView:
    """What a decoded frame shows: all that ranging may use.

    Attributes:
        sums: Polarity sums of pilot and info segment with the bar held still, int16 (chips, height, width).
        offset_px: What is left of the bar's motion in each chip: (right, down) of its centre from the middle
            of the image, float64 (2, chips), px, within half a pixel.
        presence: Where each cluster is.
        soft: What each cluster says.
    """

    sums: NDArray[np.int16]
    offset_px: NDArray[np.float64]
    presence: PresenceMap
    soft: SoftSymbols

    def __repr__(self) -> str:
        chips, height, width = self.sums.shape
        return f"FrameView({chips} chips of {width} x {height} px, {self.presence}, {self.soft})"


@dataclass(frozen=True, eq=False)
class Bend:
    """How far boundaries between clusters lie off an even scale: what the lean of a bar shows in.

    Attributes:
        place: Where the boundaries are on the bar, from its middle, in spacings of clusters, float64 (n,).
        off: How far each lies off, along the bar, in what a lean of sine 1 moves the boundary at place 1,
            which is spacing_px * spacing_m / distance_m pixels; a lean moves others by place^2. float64 (n,);
            also of those of weight 0 that were left out as they are out of line, else 0 there.
        weight: Inverse variances of these, up to a factor that all share; 0 where unseen, float64 (n,).
        wave: How far each seems off, in the same, for every pixel by which a boundary a quarter of a pixel
            beyond the middle of one seems off: the sine of its place on the pixels. None where the ranging
            does not know. float64 (n,).
        wave_m: How far the distance is off for it, m.
        spacing_px: From one cluster to the next in the image, px; NaN where the ranging does not say.
        one_px: What `off` is in, px.
    """

    place: NDArray[np.float64]
    off: NDArray[np.float64]
    weight: NDArray[np.float64]
    wave: NDArray[np.float64] | None = None
    wave_m: float = 0.0
    spacing_px: float = math.nan
    one_px: float = math.nan


@dataclass(frozen=True)
class Range:
    """A distance along the optical axis.

    Attributes:
        distance_m: Depth, m; NaN when the maps do not allow one.
        sigma_m: Its standard deviation, m.
        pairs: Number of cluster pairs that entered.
        late_chips: Of a ranging: chips from the middle of the pilot, which a frame's distance is for, to when
            the distance holds.
        bend: Of a ranging: what it says of the bar's lean; None for nothing.
        standing_m: The part of `sigma_m` that stays over frames, as what bends the bar's image does, m.
        bent_px: Of an image of a bar that is bent, or has boundaries out of line: how far each lies off a
            straight bar, along it, px, float64 (K - 1,), NaN where unseen. None of others.
    """

    distance_m: float
    sigma_m: float
    pairs: int
    late_chips: float = 0.0
    bend: Bend | None = field(default=None, compare=False)
    standing_m: float = 0.0
    bent_px: NDArray[np.float64] | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return f"Range({_distance(self)}, {self.pairs} pairs)"


@dataclass(frozen=True, eq=False)
class Frame:
    """One decoded frame: a row of `frames.csv`.

    Attributes:
        transmitter: Number of the transmitter in order of first lock, from 0.
        packet: Number of the packet since the transmitter's first, from 0.
        frame: Number of the frame in its packet, from 0.
        t_us: Start of the frame's first chip on the camera's clock, us: of its pilot, if it has one.
        soft: Symbols and log-likelihood ratios.
        range: Distance; its values are NaN when the maps do not allow one, or the frame has no pilot.
        filtered: Distance filtered over time; None without tracking.
        x_px: Column of the bar's centre in the middle of the pilot, or of the info segment without one, px.
        y_px: Row of the same, px.
        points_px: Column and row of each cluster's centre on the sensor at that time, px, float64 (K, 2); NaN
            where a cluster is not seen; empty for a frame without a pilot.
        points_sigma_px: Their standard deviations, px, float64 (K,).
        points_t_us: That time, camera clock, us.
        echo_of: Number of the transmitter that this is a reflection of; None for a frame of its own.
        link: Name of the link that it was sent with, of a receiver of several; empty of a receiver of one.
        points_flank_px: Over how many pixels a line's image fades out to each side; the narrower, the less it
            shows where in a pixel the line is. NaN where it is not known.
    """

    transmitter: int
    packet: int
    frame: int
    t_us: float
    soft: SoftSymbols
    range: Range
    filtered: Range | None
    x_px: float
    y_px: float
    points_px: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    points_sigma_px: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    points_t_us: float = math.nan
    echo_of: int | None = None
    link: str = ""
    points_flank_px: float = math.nan

    def __repr__(self) -> str:
        place = f"{_who(self.transmitter, self.echo_of)}, packet {self.packet}, frame {self.frame}"
        return f"Frame({place}, {self.t_us / 1e3:.1f} ms, {_symbols(self.soft)}, {_distance(self.range)})"


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """A frame that a framing found in a region's events.

    Attributes:
        packet: Number of its packet in the region, from 0.
        frame: Its number in the packet.
        packet_t_us: Start of the packet's first preamble chip, us.
        t_us: Start of the frame's first chip, us.
        chip_us: Length of a chip, us.
        soft: What it says.
    """

    packet: int
    frame: int
    packet_t_us: float
    t_us: float
    chip_us: float
    soft: SoftSymbols


Trust = Literal["verified", "unverified", "forged"]
"""Signed by a trusted key and not replayed; not known to be; or known not to be."""


@dataclass(frozen=True)
class ReceivedMessage:
    """A complete message, and how far it can be trusted.

    Attributes:
        transmitter: Number of the transmitter, as in `Packet`.
        packet: Number of the packet that completed it, or that changed how far it may be believed.
        t_us: Start of that packet's first preamble chip on the camera's clock, us.
        message: What was received.
        kind: What it is.
        value: What it says: a `Beacon`, a text, bytes, or what a plugin's kind makes of its payload.
        trust: How far it may be believed. Texts and data are not signed, so they are `unverified`.
        reason: Why it is not `verified`; where it is, when it was signed, and how long before
            it was received.
        age_s: Time from a verified beacon's signature, which has whole seconds, to its reception, s; of a
            message `time` from what it says to the start of that packet, below 0 where clocks disagree. None
            where that is not known.
        link: Name of the link, as in `Frame`.
    """

    transmitter: int
    packet: int
    t_us: float
    message: Message
    kind: MessageKind
    value: Any
    trust: Trust
    reason: str
    age_s: float | None = None
    link: str = ""

    @property
    def beacon(self) -> Beacon | None:
        """What a beacon says; None for other kinds."""
        return self.value if self.message.kind == Kind.BEACON else None

    def summary(self, most: int = 60) -> str:
        """What it says, the first `most` characters at least, for people to read."""
        if self.beacon is not None:
            latitude_deg, longitude_deg, height_m = self.beacon.place
            return f"beacon at {latitude_deg:.7f}, {longitude_deg:.7f} deg, {height_m:.2f} m"
        if (text := self.message.text) is not None:
            return repr(text if len(text) <= most else f"{text[:most]}...")
        if isinstance(self.value, bytes):
            return f"{len(self.message.payload)} bytes of {self.kind.name}"
        value = repr(self.value)
        return f"{self.kind.name} {value if len(value) <= most else f'{value[:most]}...'}"

    def __repr__(self) -> str:
        who = f"{self.summary()} from {self.message.transmitter_id}, {self.trust}"
        return f"ReceivedMessage({who}, {self.t_us / 1e3:.1f} ms)"


@dataclass(frozen=True, eq=False)
class Packet:
    """The frames of one packet: a line of `packets.jsonl`.

    Attributes:
        transmitter: Number of the transmitter, as in `Frame`.
        packet: Number of the packet, as in `Frame`.
        t_us: Start of its first preamble chip on the camera's clock, us.
        chip_us: Length of a chip on the camera's clock, us.
        frames: The decoded frames in order; a frame that was not received is missing here.
        sent: Number of frames that a packet has.
        block: What its bits carry; None if that is not known.
        block_packets: Packets whose LLRs were added to decode the block; 0 without one.
        messages: Those that are complete with this packet, or whose trust changed.
    """

    transmitter: int
    packet: int
    t_us: float
    chip_us: float
    frames: tuple[Frame, ...]
    sent: int
    block: Block | None = None
    block_packets: int = 0
    messages: tuple[ReceivedMessage, ...] = ()

    @property
    def echo_of(self) -> int | None:
        """Number of the transmitter that its frames, all of them, are a reflection of; None if of none."""
        return self.frames[-1].echo_of if self.frames else None

    @property
    def link(self) -> str:
        """Name of the link, as in `Frame`."""
        return self.frames[0].link if self.frames else ""

    def __repr__(self) -> str:
        found = f"{len(self.frames)} of {self.sent} frames"
        number = len(self.messages)
        messages = f", {number} message{'s' * (number != 1)}" if number else ""
        place = f"{_who(self.transmitter, self.echo_of)}, packet {self.packet}"
        return f"Packet({place}, {self.t_us / 1e3:.1f} ms, {found}{messages})"

    def _repr_html_(self) -> str:
        """The packet as a notebook shows it: a row per frame, and what its messages say."""
        rows = "".join(
            f"<tr><td>{f.frame}</td><td>{f.t_us / 1e3:.2f}</td><td>{escape(_symbols(f.soft, most=1024))}</td>"
            f"<td>{f.soft.quality:.2f}</td><td>{escape(_distance(f.range))}</td></tr>"
            for f in self.frames
        )
        head = "".join(f"<th>{name}</th>" for name in ("frame", "ms", "symbols", "quality", "distance"))
        messages = "".join(
            f"<li>{escape(f'{m.summary()} from {m.message.transmitter_id}, {m.trust}')}</li>"
            for m in self.messages
        )
        return (
            f"<p>{escape(repr(self))}</p><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
            + (f"<ul>{messages}</ul>" if messages else "")
        )


@dataclass(frozen=True, eq=False)
class Alternative:
    """One of the poses that fit where a fix is refused, as more than one does.

    Attributes:
        latitude_deg: WGS-84.
        longitude_deg: The same.
        height_m: Above the ellipsoid, m.
        enu_m: The same place in the local axes, m, float64 (3,).
        covariance_m2: Of `enu_m`, if this is the right one, float64 (3, 3); NaN where an ellipse does not
            describe its error.
        heading_deg: Where the optical axis points to, clockwise from north.
        pitch_deg: How far it points above the horizon.
        roll_deg: How far the camera's top leans to its right.
        likelihood: How likely the image is from here, against the likeliest.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    enu_m: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    likelihood: float


@dataclass(frozen=True, eq=False)
class FailedBar:
    """Where the bar that was left out of a fix stands by its image, as seen from that fix.

    Attributes:
        transmitter: Its number.
        off_m: Where it stands relative to its site: east, north, up, m, float64 (3,).
        covariance_m2: Of that, float64 (3, 3).
        missed: Probability that a test misses an error of as much.
    """

    transmitter: int
    off_m: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    missed: float

    @property
    def bias_m(self) -> float:
        """How far it is off, m."""
        return float(np.linalg.norm(self.off_m))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of that, m."""
        way = self.off_m / max(self.bias_m, 1e-12)
        return math.sqrt(max(float(way @ self.covariance_m2 @ way), 0.0))


@dataclass(frozen=True, eq=False)
class Fix:
    """A position at one time, or why there is none: a row of `fixes.csv`.

    Attributes:
        t_us: Camera clock, us.
        latitude_deg: WGS-84; NaN, as all values, where the fix is refused.
        longitude_deg: The same.
        height_m: Above the ellipsoid, m.
        enu_m: The same place in the local axes, m, float64 (3,).
        covariance_m2: Of `enu_m`, float64 (3, 3).
        noise_m2: The part of it that is new with every fix, float64 (3, 3).
        slow_m2: The part that changes as the image moves over the pixels, float64 (3, 3).
        heading_deg: Where the optical axis points to, clockwise from north.
        pitch_deg: How far it points above the horizon.
        roll_deg: How far the camera's top leans to its right.
        heading_sigma_deg: Standard deviation of the heading.
        transmitters: Numbers of the bars that count; of those in view where the fix is refused.
        verified: The places of all of them come from verified beacons, or from the user's file under an id
            that a verified beacon sent.
        refusal: Kind of refusal, empty for a fix that is given.
        detail: The refusal in words.
        standing: What is left of the covariance by its causes, as the position's moves by one sigma of each
            error that stays, m, float64 (3, k): `camera`, `attitude`, `bar N` and `doubt`, as a `Pose` has
            them.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
        freedom: Degrees of freedom; 0 where the fix is refused.
        hpl_m: Horizontal protection level: beyond it the error is with the probability `position.risk`, even
            where one part is wrong; infinite where the geometry does not protect.
        vpl_m: The vertical one.
        excluded: What was left out as the rest contradicts it: `bar N`, `heading`, `attitude`, `focal
            length`.
        source: `bars`, or `gnss`: a fix of satellites, which is taken for the track.
        contradicted: What the track stands on where it contradicts this fix, if bars and GNSS disagree.
        attitude_sigma_deg: Standard deviation of a turn of the camera about the least certain axis; NaN where
            no attitude is given.
        alternatives: Of a fix refused as `two-solutions`, the poses that fit, the likeliest first.
        suspects: Of a fix refused as `misfit`, the parts of which one, if it were left out, would explain it.
        along: The direction in which the position is the least certain, a unit vector, float64 (3,); 0 where
            that is not known.
        standing_slope: How `standing`, but for `doubt`, changes with the position along it, a metre, float64
            (3, k).
        hidden_m: By how much one part that is wrong, and whose test just passed, moves it at the most: east,
            north, up, m, float64 (3,); infinite where there is no protection level.
        failed: The bar that was left out; None where none was.
    """

    t_us: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    enu_m: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    noise_m2: NDArray[np.float64]
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    heading_sigma_deg: float
    transmitters: tuple[int, ...]
    verified: bool
    refusal: str = ""
    detail: str = ""
    slow_m2: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 3)))
    standing: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    misfit: float = math.nan
    freedom: int = 0
    hpl_m: float = math.inf
    vpl_m: float = math.inf
    excluded: tuple[str, ...] = ()
    source: str = "bars"
    contradicted: tuple[str, ...] = ()
    attitude_sigma_deg: float = math.nan
    alternatives: tuple[Alternative, ...] = ()
    suspects: tuple[str, ...] = ()
    along: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    standing_slope: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    hidden_m: NDArray[np.float64] = field(default_factory=lambda: np.full(3, math.inf))
    failed: FailedBar | None = None

    @property
    def alarms(self) -> tuple[str, ...]:
        """What a user must know before this fix is used.

        `excluded`: a part was left out; `contradicted`: bars and GNSS disagree; `unavailable`: there is no
        protection level; and the refusals `misfit` and `site-contradicted`, by which parts contradict one
        another.
        """
        if self.refusal:
            return (self.refusal,) if self.refusal in ("misfit", "site-contradicted") else ()
        out: tuple[str, ...] = ("excluded",) if self.excluded else ()
        out += ("contradicted",) if self.contradicted else ()
        return out if math.isfinite(self.hpl_m) and math.isfinite(self.vpl_m) else (*out, "unavailable")

    def __repr__(self) -> str:
        time = f"{self.t_us / 1e3:.1f} ms"
        if self.refusal:
            return f"Fix({time}, refused: {self.refusal})"
        east_m, north_m, up_m = np.sqrt(np.maximum(np.diag(self.covariance_m2), 0))
        place = f"{self.latitude_deg:.7f}, {self.longitude_deg:.7f} deg, {self.height_m:.2f} m"
        return f"Fix({time}, {place}, ± {east_m:.2g} E {north_m:.2g} N {up_m:.2g} U m)"

    @classmethod
    def refused(cls, t_us: float, transmitters: tuple[int, ...], refusal: str, detail: str) -> Self:
        """A refused fix: a time without a position, and the reason."""
        place, spread = np.full(3, math.nan), np.full((3, 3), math.nan)
        geodetic = angles = (math.nan, math.nan, math.nan)
        return cls(
            t_us, *geodetic, place, spread, spread, *angles, math.nan, transmitters, False, refusal, detail
        )


_V = TypeVar("_V")
_S = TypeVar("_S", bound=np.generic)


def changed(value: _V, **fields: Any) -> _V:
    """As `dataclasses.replace`, in a fifth of the time; of classes that check nothing and keep no slots."""
    other = object.__new__(type(value))
    vars(other).update(vars(value), **fields)
    return other


def plain(array: NDArray[_S]) -> NDArray[_S]:
    """An array as kernels take it: writeable, its elements side by side; a copy where it is not.

    For each other kind Numba would compile a kernel once more, which takes seconds.
    """
    return array if array.flags.carray else array.copy()


def _counted(t_us: NDArray[np.int64], what: str) -> str:
    """How many there are, and from when to when."""
    n = len(t_us)
    if not n:
        return f"no {what}s"
    return f"{n} {what}{'s' * (n != 1)}, {t_us[0] / 1e3:.1f} to {t_us[-1] / 1e3:.1f} ms"


def _who(transmitter: int, echo_of: int | None) -> str:
    return f"transmitter {transmitter}" + ("" if echo_of is None else f", a reflection of {echo_of}")


def _symbols(soft: SoftSymbols, most: int = 16) -> str:
    """The symbols one after another, the first `most` of them; `-` for one that is not given."""
    symbols = soft.symbols.tolist()
    text = " ".join(str(s) if s >= 0 else "-" for s in symbols[:most])
    return f"{text} ..." if len(symbols) > most else text


def _distance(found: Range) -> str:
    if math.isnan(found.distance_m):
        return "no distance"
    return f"{found.distance_m:.2f} ± {found.sigma_m:.2f} m"
