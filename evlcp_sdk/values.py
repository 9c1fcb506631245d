"""The values that flow through the receiver: events, regions, locks, presence, symbols, ranges, frames."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk import _kernels
from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind, Message
from evlcp_sdk.air.kinds import MessageKind
from evlcp_sdk.errors import StreamError, import_extra
from evlcp_sdk.formatting import shorten

if TYPE_CHECKING:
    import pandas
    import pyarrow

_COLUMNS: Final[tuple[tuple[str, np.dtype[Any]], ...]] = (
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
                    f" expected {dtype} ({self.t_us.size},)"
                )

    @classmethod
    def of(cls, t_us: Any, x: Any, y: Any, p: Any) -> Self:
        """Events from array-likes, converted to the column types; fractions of a microsecond are cut off.

        Raises:
            StreamError: A value that its column cannot hold, such as a place of -1 or 65536.
        """
        columns = []
        for (name, dtype), given in zip(_COLUMNS, (t_us, x, y, p), strict=True):
            values = np.asarray(given)
            with np.errstate(invalid="ignore"):
                columns.append(np.ascontiguousarray(values.astype(dtype, copy=False)))
            if values.dtype != dtype and not (held := np.abs(values - columns[-1]) < 1).all():
                raise StreamError(f"events column {name}: {values[~held][0]}, expected {dtype}")
        return cls(*columns)

    @classmethod
    def from_columns(
        cls, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8]
    ) -> "Events":
        """Events from columns whose types and lengths are right already: nothing is checked."""
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
        return (
            Events.from_columns(*map(np.concatenate, zip(*columns, strict=True))) if columns else cls.empty()
        )

    def to_pandas(self) -> "pandas.DataFrame":
        """Copy the events to a pandas table with the columns t_us, x, y, p.

        Raises:
            ConfigError: pandas is not installed.
        """
        columns = {name: getattr(self, name).copy() for name, _ in _COLUMNS}
        return import_extra("pandas", "pandas").DataFrame(columns)

    def to_arrow(self) -> "pyarrow.Table":
        """The events as an Arrow table with the columns t_us, x, y, p.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        return import_extra("pyarrow", "parquet").table({name: getattr(self, name) for name, _ in _COLUMNS})

    def __repr__(self) -> str:
        return f"Events({_format_count(self.t_us, 'event')})"

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, rows: Any) -> "Events":
        """The events of a slice or a mask (a view for a slice)."""
        if not isinstance(rows, slice):
            rows = np.asarray(rows)
            if rows.dtype != np.bool_ or rows.shape != self.t_us.shape:
                return Events(self.t_us[rows], self.x[rows], self.y[rows], self.p[rows])
            # Indices select events several times as fast as a mask.
            (rows,) = rows.nonzero()
        return Events.from_columns(self.t_us[rows], self.x[rows], self.y[rows], self.p[rows])


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
        return f"Triggers({_format_count(self.t_us, 'edge')})"


def span_us(events: Events, triggers: Triggers) -> tuple[int, int]:
    """First and last time of a piece of a stream that is not empty, camera clock, us."""
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
        packet_t_us: Start of a packet's first preamble chip, us, by the earliest ON events of its edges;
            other packets lie whole periods away.
        chip_us: Length of a chip on the camera's clock, us.
        delay_on_us: From a chip's start to that of the window, one chip long, that best holds the positive
            events of an edge at that start, us; negative where these events last nearly a chip.
        delay_off_us: The same for negative events.
        quality: Normalised preamble correlation, 0 to 1.
        row_us: Delay of a row's events after those of the row above, us; the other delays hold in the bar's
            centre. The receiver measures it, synchronization leaves it 0.
        last_row_us: Delay of the bar's last row after its centre, us.
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
            known. `probability` is 0 where this is 0, and is otherwise independent of it.
    """

    probability: NDArray[np.float32]
    grid_px: int
    selected: NDArray[np.bool_]
    pixels: NDArray[np.float32]
    prior: NDArray[np.float32] | None = None

    def apply_prior(self) -> "PresenceMap":
        """Combine `probability` with the prior by Bayes' rule; the map itself where there is no prior.

        The probability alone also says how well a cell can be read; a decoding that knows that by other means
        counts a dim cell in the right place in full.
        """
        if self.prior is None:
            return self
        probability = np.empty_like(self.probability)
        _kernels.update_posterior(self.probability, self.prior, probability)
        return replace_fields(self, probability=probability)

    def __repr__(self) -> str:
        clusters, rows, columns = self.selected.shape
        seen = int(self.selected.any(axis=(1, 2)).sum())
        cells = f"{columns} x {rows} cells of {self.grid_px} px"
        return f"PresenceMap({seen} of {clusters} clusters seen, {cells})"


@dataclass(frozen=True, eq=False)
class SoftSymbols:
    """The symbols of one frame, and how certain they are.

    Attributes:
        symbols: Most likely symbol of each cluster, int64 (K,); -1 where none is given: the cluster was not
            seen, or its symbol is more likely wrong than right.
        llr: Log-likelihood ratio ln P(bit 0) / P(bit 1) of each bit, most significant first, float32 (K, m);
            0 where a cluster was not seen.
        quality: Probability that all given symbols are right, 0 to 1: of frames with quality q, about 1 - q
            have a wrong bit. The receiver computes it from the LLRs, whatever a decoding gives here.
    """

    symbols: NDArray[np.int64]
    llr: NDArray[np.float32]
    quality: float

    def __repr__(self) -> str:
        return f"SoftSymbols({_format_symbols(self)}, quality {self.quality:.2f})"


@dataclass(frozen=True, eq=False)
class FrameView:
    """The image of a decoded frame: all that ranging may use.

    Attributes:
        sums: Polarity sums of pilot and info segment with the bar held still, int16 (chips, height, width).
        offset_px: The bar's remaining motion in each chip: (right, down) of its centre from the middle of the
            image, float64 (2, chips), px, within half a pixel.
        presence: Where each cluster is.
        soft: The symbol of each cluster.
    """

    sums: NDArray[np.int16]
    offset_px: NDArray[np.float64]
    presence: PresenceMap
    soft: SoftSymbols

    def __repr__(self) -> str:
        chips, height, width = self.sums.shape
        return f"FrameView({chips} chips of {width} x {height} px, {self.presence}, {self.soft})"


@dataclass(frozen=True, eq=False)
class Curvature:
    """How far the boundaries between clusters lie off an even scale, which shows the tilt of a bar.

    Attributes:
        place: Positions of the boundaries on the bar, from its middle, in spacings of clusters, float64 (n,).
        offset: How far each lies off, along the bar, float64 (n,). The unit is the shift of the boundary at
            place 1 by a tilt of sine 1, spacing_px * spacing_m / distance_m pixels; a tilt shifts others by
            place^2. Of a boundary of weight 0: how far it was off when it was rejected, else 0.
        weight: Inverse variances of these, up to a common factor; 0 where unseen, float64 (n,).
        phase_bias: Their pixel-phase bias, in the same unit, float64 (n,): the sine of a boundary's position
            on the pixels, for an amplitude of one pixel. None where the ranging does not know it.
        phase_bias_m: What this bias does to the distance, m.
        spacing_px: From one cluster to the next in the image, px; NaN where the ranging does not give it.
        unit_px: The unit of `offset`, px.
    """

    place: NDArray[np.float64]
    offset: NDArray[np.float64]
    weight: NDArray[np.float64]
    phase_bias: NDArray[np.float64] | None = None
    phase_bias_m: float = 0.0
    spacing_px: float = math.nan
    unit_px: float = math.nan


@dataclass(frozen=True)
class Range:
    """A distance along the optical axis.

    Attributes:
        distance_m: Depth, m; NaN where the frame allows none.
        sigma_m: Its standard deviation, m.
        pairs: Number of pairs of clusters, boundaries or clusters that were used.
        late_chips: Of a ranging: chips from the middle of the pilot, the time of a frame's distance, to the
            time for which this distance holds.
        curvature: Of a ranging: the boundaries of the bar; None where it does not give them.
        standing_m: The part of `sigma_m` that persists over frames, as of a distorted image, m.
        distortion_px: Of a distorted image, or one with boundaries out of line: how far each lies off a
            straight bar, along it, px, float64 (K - 1,), NaN where unseen. None of others.
    """

    distance_m: float
    sigma_m: float
    pairs: int
    late_chips: float = 0.0
    curvature: Curvature | None = field(default=None, compare=False)
    standing_m: float = 0.0
    distortion_px: NDArray[np.float64] | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return f"Range({_format_distance(self)}, {self.pairs} pairs)"


NO_RANGE = Range(math.nan, math.nan, 0)
"""No distance was measured."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One decoded frame: a row of `frames.csv`.

    Attributes:
        transmitter: Number of the transmitter in order of first lock, from 0.
        packet: Number of the packet since the transmitter's first, from 0.
        frame: Number of the frame in its packet, from 0.
        t_us: Start of the frame's first chip (of its pilot, if it has one), camera clock, us.
        soft: Symbols and log-likelihood ratios.
        range: Distance; NaN where the frame allows none, or has no pilot.
        filtered: Distance filtered over time; None without tracking.
        x_px: Column of the bar's centre in the middle of the pilot, or of the info segment without one, px.
        y_px: Row of the same, px.
        points_px: Column and row of each cluster's centre on the sensor at that time, px, float64 (K, 2); NaN
            where a cluster is not seen; empty for a frame without a pilot.
        points_sigma_px: Their standard deviations, px, float64 (K,).
        points_t_us: That time, camera clock, us.
        echo_of: Number of the transmitter that this is a reflection of; None where it is none.
        link: Name of the link that it was sent with; empty if the receiver has one link only.
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
        transmitter = _format_transmitter(self.transmitter, self.echo_of)
        content = f"{_format_symbols(self.soft)}, {_format_distance(self.range)}"
        time = f"{self.t_us / 1e3:.1f} ms"
        return f"Frame({transmitter}, packet {self.packet}, frame {self.frame}, {time}, {content})"


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """A frame that a framing found in a region's events.

    Attributes:
        packet: Number of its packet in the region, from 0.
        frame: Its number in the packet.
        packet_t_us: Start of the packet's first preamble chip, us.
        t_us: Start of the frame's first chip, us.
        chip_us: Length of a chip, us.
        soft: Its symbols.
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
        packet: Number of the packet that completed it, or that changed its trust.
        t_us: Start of that packet's first preamble chip on the camera's clock, us.
        message: What was received.
        kind: What it is.
        value: Its content: a `Beacon`, a text, bytes, or what a plugin's kind makes of its payload.
        trust: Whether it is authentic. Texts and data are not signed, so they are `unverified`.
        reason: Why it is not `verified`; where it is, when it was signed, and how long before its reception.
        age_s: Time from a verified beacon's signature, which has whole seconds, to its reception, s; of a
            message `time` from its content to the start of that packet, below 0 where clocks disagree. None
            where it is not known.
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
        """The content of a beacon; None for other kinds."""
        return self.value if self.message.kind == Kind.BEACON else None

    def summary(self, most: int = 60) -> str:
        """The content for people to read, with at least the first `most` characters of it."""
        if self.beacon is not None:
            latitude_deg, longitude_deg, height_m = self.beacon.place
            return f"beacon at {latitude_deg:.7f}, {longitude_deg:.7f} deg, {height_m:.2f} m"
        if (text := self.message.text) is not None:
            return repr(shorten(text, most))
        if isinstance(self.value, bytes):
            return f"{len(self.message.payload)} bytes of {self.kind.name}"
        return f"{self.kind.name} {shorten(repr(self.value), most)}"

    def __repr__(self) -> str:
        content = f"{self.summary()} from {self.message.transmitter_id}, {self.trust}"
        return f"ReceivedMessage({content}, {self.t_us / 1e3:.1f} ms)"


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
        block: The message block in its bits; None where it is not known.
        block_packets: Packets whose LLRs were added to decode the block; 0 without one.
        messages: Those that this packet completed, or whose trust it changed.
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
        """Number of the transmitter that all its frames are a reflection of; None where they are none."""
        return self.frames[-1].echo_of if self.frames else None

    @property
    def link(self) -> str:
        """Name of the link, as in `Frame`."""
        return self.frames[0].link if self.frames else ""

    def __repr__(self) -> str:
        frames = f"{len(self.frames)} of {self.sent} frames"
        number = len(self.messages)
        messages = f", {number} message{'s' * (number != 1)}" if number else ""
        place = f"{_format_transmitter(self.transmitter, self.echo_of)}, packet {self.packet}"
        return f"Packet({place}, {self.t_us / 1e3:.1f} ms, {frames}{messages})"

    def _repr_html_(self) -> str:
        """The packet as a notebook shows it: a row per frame, and the messages."""
        rows = "".join(
            f"<tr><td>{f.frame}</td><td>{f.t_us / 1e3:.2f}</td>"
            f"<td>{escape(_format_symbols(f.soft, most=1024))}</td>"
            f"<td>{f.soft.quality:.2f}</td><td>{escape(_format_distance(f.range))}</td></tr>"
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
    """One of several poses that fit, where a fix is refused for that.

    Attributes:
        latitude_deg: WGS-84.
        longitude_deg: The same.
        height_m: Above the ellipsoid, m.
        enu_m: The same place in the local axes, m, float64 (3,).
        covariance_m2: Of `enu_m`, if this is the right one, float64 (3, 3); NaN where an ellipse does not
            describe its error.
        heading_deg: Direction of the optical axis, clockwise from north.
        pitch_deg: Its angle above the horizon.
        roll_deg: Tilt of the camera's top to its right.
        likelihood: How likely the image is from here, relative to the likeliest pose.
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
    """The bar that was left out of a fix, and how far off its site it stands as seen from that fix.

    Attributes:
        transmitter: Its number.
        off_m: Where it stands relative to its site: east, north, up, m, float64 (3,).
        covariance_m2: Covariance of this, float64 (3, 3).
        missed_probability: Probability that the test misses an error as large as this.
    """

    transmitter: int
    off_m: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    missed_probability: float

    @property
    def bias_m(self) -> float:
        """How far it is off, m."""
        return float(np.linalg.norm(self.off_m))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of that, m."""
        direction = self.off_m / max(self.bias_m, 1e-12)
        return math.sqrt(max(float(direction @ self.covariance_m2 @ direction), 0.0))


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
        heading_deg: Direction of the optical axis, clockwise from north.
        pitch_deg: Its angle above the horizon.
        roll_deg: Tilt of the camera's top to its right.
        heading_sigma_deg: Standard deviation of the heading.
        transmitters: Numbers of the bars it is computed from; of those in view where the fix is refused.
        verified: The places of all of them come from verified beacons, or from the user's file under an id
            that a verified beacon sent.
        refusal: Kind of refusal; empty for a fix that is given.
        detail: The refusal in words.
        standing: The rest of the covariance by its causes, as the position's shifts by one sigma of each
            standing error, m, float64 (3, k): `camera`, `attitude`, `bar N` and `attitude-excess`, as in a
            `Pose`.
        misfit: Mean square of the residuals in sigmas, over the degrees of freedom.
        freedom: Degrees of freedom; 0 where the fix is refused.
        hpl_m: Horizontal protection level: the error exceeds it with the probability `position.risk`, even
            where one part is wrong; infinite where the geometry does not protect.
        vpl_m: The vertical one.
        excluded: What was left out as the rest contradicts it: `bar N`, `heading`, `attitude`, `focal
            length`.
        source: `bars`, or `gnss`: a fix of satellites, which the track uses.
        contradicted: What the track relies on where it contradicts this fix, if bars and GNSS disagree.
        attitude_sigma_deg: Standard deviation of a turn of the camera about the least certain axis; NaN where
            no attitude is given.
        alternatives: Of a fix refused as `two-solutions`, the poses that fit, the likeliest first.
        suspects: Of a fix refused as `misfit`, the parts that would each explain it if left out.
        weakest_axis: The direction in which the position is least certain, a unit vector, float64 (3,); 0
            where it is not known.
        standing_slope: Change of `standing`, but for `attitude-excess`, a metre along this axis, float64
            (3, k).
        undetected_m: Largest shift by one wrong part whose test just passed: east, north, up, m, float64
            (3,); infinite where there is no protection level.
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
    weakest_axis: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    standing_slope: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    undetected_m: NDArray[np.float64] = field(default_factory=lambda: np.full(3, math.inf))
    failed: FailedBar | None = None

    @property
    def alarms(self) -> tuple[str, ...]:
        """What a user must know before using this fix.

        `excluded`: a part was left out; `contradicted`: bars and GNSS disagree; `unavailable`: there is no
        protection level; and the refusals for parts that contradict one another, `misfit` and
        `site-contradicted`.
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
    def from_refusal(cls, t_us: float, transmitters: tuple[int, ...], refusal: str, detail: str) -> Self:
        """A fix without a position, and the reason."""
        place, spread = np.full(3, math.nan), np.full((3, 3), math.nan)
        geodetic = angles = (math.nan, math.nan, math.nan)
        return cls(
            t_us, *geodetic, place, spread, spread, *angles, math.nan, transmitters, False, refusal, detail
        )


def sigmas(covariance: NDArray[np.float64]) -> list[float]:
    """Standard deviations of a covariance."""
    deviations: list[float] = np.sqrt(np.diag(covariance)).tolist()
    return deviations


_K = TypeVar("_K")
_V = TypeVar("_V")
_S = TypeVar("_S", bound=np.generic)


def find_quantile_bin(counts: Mapping[int, int], share: float) -> int | None:
    """The first bin of a histogram up to which it holds a share of its counts; None where it is empty."""
    seen, enough = 0, share * sum(counts.values())
    for bin in sorted(counts):
        seen += counts[bin]
        if seen >= enough:
            return bin
    return None


def replace_fields(value: _V, **fields: Any) -> _V:
    """As `dataclasses.replace`, five times as fast; for classes without checks and slots."""
    copy = object.__new__(type(value))
    vars(copy).update(vars(value), **fields)
    return copy


def remember_newest(known: dict[_K, _V], key: _K, value: _V, most: int) -> dict[_K, _V]:
    """Put a value at the end of a dictionary; drop and return those at its front, beyond `most`.

    >>> known = {1: "a", 2: "b"}
    >>> remember_newest(known, 1, "c", 2), remember_newest(known, 3, "d", 2), known
    ({}, {2: 'b'}, {1: 'c', 3: 'd'})
    """
    known.pop(key, None)
    known[key] = value
    return {old: known.pop(old) for old in list(islice(known, max(len(known) - most, 0)))}


def to_kernel_array(array: NDArray[_S]) -> NDArray[_S]:
    """An array as kernels take it, writeable and contiguous; a copy where it is not.

    For every other layout Numba would compile a kernel anew, which takes seconds.
    """
    return array if array.flags.carray else array.copy()


def _format_count(t_us: NDArray[np.int64], what: str) -> str:
    n = len(t_us)
    if not n:
        return f"no {what}s"
    return f"{n} {what}{'s' * (n != 1)}, {t_us[0] / 1e3:.1f} to {t_us[-1] / 1e3:.1f} ms"


def _format_transmitter(transmitter: int, echo_of: int | None) -> str:
    return f"transmitter {transmitter}" + ("" if echo_of is None else f", a reflection of {echo_of}")


def _format_symbols(soft: SoftSymbols, most: int = 16) -> str:
    symbols = soft.symbols.tolist()
    text = " ".join(str(s) if s >= 0 else "-" for s in symbols[:most])
    return f"{text} ..." if len(symbols) > most else text


def _format_distance(range_: Range) -> str:
    if math.isnan(range_.distance_m):
        return "no distance"
    return f"{range_.distance_m:.2f} ± {range_.sigma_m:.2f} m"
