"""Messages of the driver board; `python -m firmware_host.protocol.generate` writes this file."""

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Annotated, ClassVar

from firmware_host.protocol.wire import I16, U8, U16, U32, Rest, WireMessage, WireRequest

MAJOR = 2  #: Version of the protocol: of another major one no message is understood.
MINOR = 2  #: Version of the protocol: what it has beyond the major version's first.
HEADER_BYTES = 6
CRC_BYTES = 4
MAX_PAYLOAD = 512
WINDOW = 6
DEFAULT_BAUD = 1000000
CLUSTERS = 16
LEDS = 96
ROW_BYTES = 12
REPLY_BIT = 0x80  #: Set in the type of a reply.
NO_BANK = 0xFF  #: No bank.
NO_SESSION = 0x0  #: Session of a HELLO request, and of a board that knows no host.
SEALED = 0x1  #: Status of a request that ends with a seal.
SEAL_BYTES = 0x10  #: Length of a seal, at the end of the payload.
KEY_BYTES = 0x10  #: Length of a board's key.
CHALLENGE_BYTES = 0x8  #: Length of a session's challenge.
KEY_NAME_BYTES = 0x4  #: First bytes of a key's SHA-256, which name it.
CHIP_DARK = 0xFFFFFFFF  #: Chip number in an LED record: output is dark, no chip.
CHIP_TEST = 0xFFFFFFFE  #: Chip number in an LED record: single-LED test, no chip.


class Type(IntEnum):
    """Requests."""

    HELLO = 0x01
    CONFIGURE = 0x02
    CODEBOOK = 0x03
    WRITE = 0x04
    READ = 0x05
    CRC = 0x06
    COMMIT = 0x07
    START = 0x08
    STOP = 0x09
    BLANK = 0x0A
    LEVEL = 0x0B
    STATUS = 0x0C
    WATCHDOG = 0x0D
    SAVE = 0x0E
    RECALL = 0x0F
    LED_TEST = 0x10
    STREAM = 0x18
    PUSH = 0x19
    KEY = 0x1A
    CHIPS = 0x1B
    UPDATE_STATUS = 0x20
    UPDATE_BEGIN = 0x21
    UPDATE_WRITE = 0x22
    UPDATE_COMMIT = 0x23
    UPDATE_RESTART = 0x24
    UPDATE_CONFIRM = 0x25


class Status(IntEnum):
    """How a request ended."""

    OK = 0  #: Done.
    UNKNOWN_TYPE = 1  #: The board does not know this request.
    BAD_LENGTH = 2  #: The payload has another length than the request's; detail: expected length.
    OUT_OF_RANGE = 3  #: A value the board cannot take; detail: the nearest value it can.
    BUSY = 4  #: Not while playing or, for flash, in a LED test; or the bank is playing or about to.
    BAD_CRC = 5  #: The bank's content has another CRC; detail: the CRC found.
    FOREIGN_CODEBOOK = 6  #: The codebook's digest is not the one that belongs here.
    NO_SESSION = 7  #: The board was reset, or another host has said HELLO.
    STALE = 8  #: Older than a request already done; not done.
    NOTHING_COMMITTED = 9  #: No bank has been committed.
    INCOMPATIBLE = 10  #: The host's major version is another one.
    FLASH_FAULT = 11  #: The flash did not take or give the data.
    NOT_SUPPORTED = 12  #: This board cannot do that.
    EMPTY_SLOT = 13  #: No flash slot holds a valid setting.
    HARDWARE_FAULT = 14  #: A fault holds the LEDs dark; detail: fault bits.
    NEEDS_KEY = 16  #: The board has a key: what changes something must be sealed with it.
    BAD_SEAL = 17  #: The seal is of another key, or of another request.
    #: LEDs would be on for longer than the limits allow; detail: the share that they allow, permille.
    TOO_BRIGHT = 15


class Format(IntEnum):
    """What a bank holds."""

    WORDS = 0  #: Info words u16 [packet][frame][cluster]; the board adds preamble and pilots.
    MASKS = 1  #: Chip masks, row_bytes a chip, LED 0 the most significant bit of the first byte.
    CLUSTERS = 2  #: The mask of each cluster, then chips: whole bytes, a bit a cluster, cluster 0 first.


class Profile(IntEnum):
    """Info-segment profiles of air interface 1."""

    WH4X2 = 0  #: Two words of H_4, 6 bits a symbol.
    WH8 = 1  #: One word of H_8, 4 bits a symbol.
    RAW8 = 2  #: Eight plain values, 8 bits a symbol.
    CUSTOM = 255  #: A codebook the firmware was not built with.


class State(IntEnum):
    """What the LEDs do."""

    DARK = 0  #: Dark; the chip timer stands.
    PLAYING = 1  #: Packets of the active bank.
    STOPPING = 2  #: The last packet before dark.
    #: The idle pattern: LEDs are on for a chip of two, or of more where the limits ask for it.
    IDLE_PATTERN = 3
    TESTING = 4  #: Single-LED test.
    FAULT = 5  #: Dark because of a fault.
    WAITING = 6  #: Dark until the pulse or the clock that START names.


class Watchdog(IntEnum):
    """What happens when the host falls silent."""

    KEEP = 0  #: Go on playing.
    IDLE = 1  #: Idle pattern from the next packet boundary until the host sends again.
    DARK = 2  #: Dark after the packet; START plays again.


class Capability(IntFlag):
    """Bits of HELLO.capabilities."""

    FLASH = 1  #: SAVE and RECALL.
    LEVEL = 2  #: LEVEL sets the LED current.
    TEMPERATURE = 4  #: STATUS.temperature_dc is measured.
    OPEN_LED = 8  #: STATUS.open_leds is measured.
    RECORDS = 16  #: LED outputs are recorded (emulators).
    TRUST = 64  #: KEY: requests that change something are sealed.
    STREAM = 32  #: STREAM and PUSH: packets as they come.
    PULSE = 512  #: START at a pulse of the pulse input, in step with it from then on, or at a clock.
    UPDATE = 256  #: UPDATE_*: takes another image of its firmware.


class BoardFault(IntFlag):
    """Bits of STATUS.faults."""

    #: The drivers are too hot, or the sensor's wire is broken: LEDs dark until they cool and START.
    OVER_TEMPERATURE = 1
    OPEN_LED = 2  #: A LED or its wire is open; playing goes on.
    CLOCK = 4  #: The crystal did not start, or stopped: LEDs dark, timing would be wrong.
    CHIP_LOST = 8  #: A chip interrupt came a whole chip late, or chips stopped: LEDs dark.
    WATCHDOG = 16  #: The host fell silent and the watchdog acted; cleared by the next control request.
    OVER_LIMIT = 32  #: What came next was beyond the limits of light: not shown, LEDs dark until START.
    #: The stream is empty though its end was not announced: idle pattern until the next packet.
    UNDERRUN = 64
    #: No pulse came, or none that fits: the board goes on by its own clock; until the next START.
    PULSE = 256


@dataclass(frozen=True, slots=True)
class EmptyReply(WireMessage):
    """What the board answers where there is nothing to say."""


@dataclass(frozen=True, slots=True)
class HelloReply(WireMessage):
    """What the board answers to HELLO."""

    major: U8  #: The board's protocol.
    minor: U8  #: The board's protocol: what came later it does not know.
    session: U16  #: Goes into the header of every further request.
    version_major: U8  #: Firmware version.
    version_minor: U8  #: Firmware version.
    version_patch: U8  #: Firmware version.
    window: U8  #: Requests the host may have under way.
    max_payload: U16  #: Largest payload, bytes.
    banks: U8  #: Number of banks.
    bank_bytes: U32  #: Size of a bank, bytes.
    clusters: U8  #: Clusters.
    leds: U16  #: LEDs.
    tick_hz: U32  #: Rate of the tick counter that times the chips.
    chip_rate_max_hz: U32  #: Fastest chip rate.
    level_max_ma: U16  #: Largest LED current, mA.
    mean_max_ma: U16  #: Largest mean of a LED's current, mA.
    burst_chips: U16  #: Chips that a LED may be on beyond its share of any stretch of chips.
    capabilities: U32  #: Capability bits.
    unique_id: Annotated[bytes, "12s"]  #: The part's own number.
    uptime_ms: U32  #: Time since reset; smaller than before means a reset.
    hal: Annotated[bytes, "12s"]  #: Name of the hardware layer, ASCII, zero-padded.
    clock_hz: U32 = field(default=0, metadata={"since": 1})  #: Rate of STATUS's clock, nominal.
    #: Drawn for the session: seals are over it.
    challenge: Annotated[bytes, "8s"] = field(default=bytes(8), metadata={"since": 1})
    #: First bytes of the SHA-256 of the board's key; zeros without one.
    key_name: Annotated[bytes, "4s"] = field(default=bytes(4), metadata={"since": 1})
    #: What a bank may hold, 1 << format; 0: words and masks, in packets of a codebook.
    formats: U16 = field(default=0, metadata={"since": 2})
    chip_rate_min_hz: U32 = field(default=0, metadata={"since": 2})  #: Slowest chip rate.


@dataclass(frozen=True, slots=True)
class HelloRequest(WireRequest[HelloReply]):
    """Open a session and learn the board. Its first two fields never change between versions."""

    TYPE: ClassVar[int] = 0x01
    major: U8  #: The host's protocol; another major version is INCOMPATIBLE.
    minor: U8  #: The host's protocol.
    nonce: U32  #: Random; the same nonce keeps the session.


@dataclass(frozen=True, slots=True)
class ConfigureReply(WireMessage):
    """What the board answers to CONFIGURE."""

    ticks_per_chip: U32  #: Length of a chip in ticks.
    packet_chips: U32  #: Length of a packet in chips.


@dataclass(frozen=True, slots=True)
class ConfigureRequest(WireRequest[ConfigureReply]):
    """Set what the next COMMIT plays with, not what plays; and limits of light, which hold at once."""

    TYPE: ClassVar[int] = 0x02
    chip_rate_hz: U32  #: Chips per second; must divide the tick rate; not changed while playing.
    profile: U8  #: Info-segment profile.
    frames: U16  #: Frames per packet.
    pilot_every: U8  #: Frames from one pilot to the next; 1: every frame has one.
    level_limit_ma: U16  #: Largest LED current from now on, mA; 0: as it is.
    duty_limit: U16  #: Largest share of time that a LED is on from now on, permille; 0: as it is.


@dataclass(frozen=True, slots=True)
class CodebookRequest(WireRequest[EmptyReply]):
    """Set preamble and pilots for the next COMMIT; those of a built-in profile must be the firmware's own."""

    TYPE: ClassVar[int] = 0x03
    preamble_chips: U8  #: Chips of the preamble, at most 32.
    preamble: U32  #: Preamble, first chip on air the most significant of preamble_chips bits.
    pilots: Annotated[bytes, "32s"]  #: Pilot words, first chip on air the most significant bit.
    digest: Annotated[bytes, "32s"]  #: SHA-256 of the codebook.


@dataclass(frozen=True, slots=True)
class WriteReply(WireMessage):
    """What the board answers to WRITE."""

    bank: U8  #: Bank.
    offset: U32  #: First byte.
    count: U16  #: Bytes written.


@dataclass(frozen=True, slots=True)
class WriteRequest(WireRequest[WriteReply]):
    """Write into a spare bank; voids what was committed in it."""

    TYPE: ClassVar[int] = 0x04
    bank: U8  #: Bank.
    offset: U32  #: First byte.
    data: Rest  #: Content.


@dataclass(frozen=True, slots=True)
class ReadReply(WireMessage):
    """What the board answers to READ."""

    bank: U8  #: Bank.
    offset: U32  #: First byte.
    data: Rest  #: Content.


@dataclass(frozen=True, slots=True)
class ReadRequest(WireRequest[ReadReply]):
    """Read from a bank."""

    TYPE: ClassVar[int] = 0x05
    bank: U8  #: Bank.
    offset: U32  #: First byte.
    count: U16  #: Bytes wanted.


@dataclass(frozen=True, slots=True)
class CrcReply(WireMessage):
    """What the board answers to CRC."""

    crc: U32  #: CRC of the bytes.


@dataclass(frozen=True, slots=True)
class CrcRequest(WireRequest[CrcReply]):
    """CRC-32/ISO-HDLC of a bank's bytes."""

    TYPE: ClassVar[int] = 0x06
    bank: U8  #: Bank.
    offset: U32  #: First byte.
    length: U32  #: Bytes.


@dataclass(frozen=True, slots=True)
class CommitReply(WireMessage):
    """What the board answers to COMMIT."""

    commits: U32  #: Commits accepted since reset.


@dataclass(frozen=True, slots=True)
class CommitRequest(WireRequest[CommitReply]):
    """Check a bank; play it from the next packet boundary, or, if the check fails, go on with the old one."""

    TYPE: ClassVar[int] = 0x07
    bank: U8  #: Bank.
    format: U8  #: What the bank holds.
    packets: U16  #: Packets in the bank.
    length: U32  #: Bytes in the bank.
    crc: U32  #: CRC-32 of those bytes.
    digest: Annotated[bytes, "32s"]  #: Digest of the codebook the content was made with.


@dataclass(frozen=True, slots=True)
class StartRequest(WireRequest[EmptyReply]):
    """Play the active bank from its first packet; nothing happens if it plays."""

    TYPE: ClassVar[int] = 0x08
    #: Begin at this pulse, as STATUS counts them, and keep in step; 0: not.
    at_pulse: U32 = field(default=0, metadata={"since": 1})
    pulse_hz: U16 = field(default=0, metadata={"since": 1})  #: Pulses a second; must divide the chip rate.
    #: Without a pulse: begin when STATUS's clock stands here, at most half its range ahead; 0: at once.
    at_clock: U32 = field(default=0, metadata={"since": 1})


@dataclass(frozen=True, slots=True)
class StopRequest(WireRequest[EmptyReply]):
    """Finish the packet, then dark; a stream ends, and what waits in it is dropped."""

    TYPE: ClassVar[int] = 0x09


@dataclass(frozen=True, slots=True)
class BlankRequest(WireRequest[EmptyReply]):
    """Dark at once, within the packet."""

    TYPE: ClassVar[int] = 0x0A


@dataclass(frozen=True, slots=True)
class LevelRequest(WireRequest[EmptyReply]):
    """Set the LED current; refused above its limit, or if what is committed were too bright."""

    TYPE: ClassVar[int] = 0x0B
    level_ma: U16  #: LED current, mA.


@dataclass(frozen=True, slots=True)
class StatusReply(WireMessage):
    """What the board answers to STATUS."""

    state: U8  #: State.
    faults: U16  #: Fault bits.
    active_bank: U8  #: Bank that plays or would play, or no_bank.
    pending_bank: U8  #: Bank waiting for the packet boundary, or no_bank.
    format: U8  #: Format of the active bank.
    profile: U8  #: Profile of the active bank.
    frames: U16  #: Frames per packet of the active bank.
    pilot_every: U8  #: Frames from one of its pilots to the next.
    packets: U16  #: Packets in the active bank.
    length: U32  #: Bytes in the active bank.
    crc: U32  #: CRC-32 of the active bank.
    chip_rate_hz: U32  #: Chips per second, as configured.
    commits: U32  #: Commits accepted since reset.
    packets_sent: U32  #: Packets played to their end since reset.
    chips_sent: U32  #: Chips since reset.
    lateness_ticks: U32  #: Delay of the latest chip.
    lateness_max_ticks: U32  #: Largest delay since START.
    crc_errors: U32  #: Datagrams with a wrong CRC.
    framing_errors: U32  #: Datagrams too short, too long or no COBS.
    overflow_errors: U32  #: Bytes lost because the receive buffer was full.
    requests: U32  #: Good datagrams received.
    level_ma: U16  #: LED current, mA.
    level_limit_ma: U16  #: Largest LED current that LEVEL takes, mA.
    duty_limit: U16  #: Largest share of time that a LED may be on, permille; with a large LED current less.
    duty: U16  #: Share of time that the active bank has a LED on, that of the brightest, permille.
    temperature_dc: I16  #: Driver temperature, 0.1 degree C.
    open_leds: Annotated[bytes, "12s"]  #: A bit a LED: open.
    watchdog: U8  #: Watchdog action.
    watchdog_ms: U32  #: Watchdog time-out.
    silence_ms: U32  #: Time since the request before this one, HELLO left out.
    uptime_ms: U32  #: Time since reset.
    digest: Annotated[bytes, "32s"]  #: Digest of the active bank's codebook, or of the one set.
    underruns: U32  #: How often the active bank's stream was empty before its end was announced.
    clock: U32 = field(default=0, metadata={"since": 1})  #: The board's clock, which counts freely and wraps.
    pulses: U32 = field(default=0, metadata={"since": 1})  #: Pulses of the pulse input since reset.
    #: Clocks from the pulse before to the latest; 0: unknown.
    pulse_clocks: U32 = field(default=0, metadata={"since": 1})
    #: Length of a packet of the active bank, in chips of the chip rate.
    packet_chips: U32 = field(default=0, metadata={"since": 2})
    #: How many of these a chip of the bank lasts; 0: the bank is of a codebook.
    hold: U8 = field(default=0, metadata={"since": 2})
    #: Clusters of the active bank's masks; 0 without these.
    clusters: U8 = field(default=0, metadata={"since": 2})


@dataclass(frozen=True, slots=True)
class StatusRequest(WireRequest[StatusReply]):
    """What the board does, and what went wrong since reset."""

    TYPE: ClassVar[int] = 0x0C


@dataclass(frozen=True, slots=True)
class WatchdogRequest(WireRequest[EmptyReply]):
    """What to do when the host falls silent."""

    TYPE: ClassVar[int] = 0x0D
    action: U8  #: Watchdog action.
    timeout_ms: U32  #: Silence before it acts, at least 100 ms.


@dataclass(frozen=True, slots=True)
class SaveReply(WireMessage):
    """What the board answers to SAVE."""

    slot: U8  #: Slot written.
    save_sequence: U32  #: Its sequence number.


@dataclass(frozen=True, slots=True)
class SaveRequest(WireRequest[SaveReply]):
    """Save active bank and settings to the older of two flash slots; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x0E
    autostart: U8  #: 1: recall and play after a reset.


@dataclass(frozen=True, slots=True)
class RecallReply(WireMessage):
    """What the board answers to RECALL."""

    slot: U8  #: Slot read.
    save_sequence: U32  #: Its sequence number.


@dataclass(frozen=True, slots=True)
class RecallRequest(WireRequest[RecallReply]):
    """Commit what the newest valid flash slot holds; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x0F


@dataclass(frozen=True, slots=True)
class LedTestRequest(WireRequest[EmptyReply]):
    """Walk over LEDs one by one, at their mean current at most; not while playing. STOP or BLANK ends it."""

    TYPE: ClassVar[int] = 0x10
    first: U8  #: First LED.
    last: U8  #: Last LED.
    dwell_ms: U16  #: Time a LED is on, at least 1 ms.


@dataclass(frozen=True, slots=True)
class StreamReply(WireMessage):
    """What the board answers to STREAM."""

    slots: U16  #: Packets that the queue holds, the one that plays among them.


@dataclass(frozen=True, slots=True)
class StreamRequest(WireRequest[StreamReply]):
    """Make a spare bank an empty queue of packets and play from it; idle pattern while it is empty."""

    TYPE: ClassVar[int] = 0x18
    bank: U8  #: Bank.
    format: U8  #: What a packet holds.
    digest: Annotated[bytes, "32s"]  #: Digest of the codebook that packets are made with.


@dataclass(frozen=True, slots=True)
class PushReply(WireMessage):
    """What the board answers to PUSH."""

    number: U32  #: Number of the packet that is next: those before it are there.
    offset: U16  #: Bytes of it that are there.
    begun: U32  #: Packets that have begun to play.
    underruns: U32  #: How often the queue was empty before its end was announced.


@dataclass(frozen=True, slots=True)
class PushRequest(WireRequest[PushReply]):
    """Put a piece of a packet into the queue, if it is the next and there is room; the reply says what is."""

    TYPE: ClassVar[int] = 0x19
    bank: U8  #: Bank.
    number: U32  #: Number of the packet, from 0 on.
    offset: U16  #: First byte.
    last: U8  #: 1: no further packet comes, dark after what is there; 0: playing goes on.
    data: Rest  #: Content.


@dataclass(frozen=True, slots=True)
class KeyRequest(WireRequest[EmptyReply]):
    """Set the key that requests which change something are sealed with; SAVE keeps it."""

    TYPE: ClassVar[int] = 0x1A
    SINCE: ClassVar[int] = 1
    key: Annotated[bytes, "16s"]  #: The key; zeros for none.


@dataclass(frozen=True, slots=True)
class ChipsRequest(WireRequest[EmptyReply]):
    """Set packets of chips alone for the next COMMIT or STREAM, in place of a codebook."""

    TYPE: ClassVar[int] = 0x1B
    SINCE: ClassVar[int] = 2
    packet_chips: U32  #: Chips of a packet in the bank.
    hold: U8  #: How many chips of the chip rate each of them lasts, from 1 on.
    clusters: U8  #: Clusters of the format CLUSTERS; 0: MASKS only.
    digest: Annotated[bytes, "32s"]  #: SHA-256 of what chips mean, which COMMIT repeats.


@dataclass(frozen=True, slots=True)
class UpdateStatusReply(WireMessage):
    """What the board answers to UPDATE_STATUS."""

    running: U8  #: Image that runs: 0 the one that was flashed, 1 or 2 one that came by an update.
    trial: U8  #: 1: it runs on trial, and is left at the third reset unless it is confirmed.
    next: U8  #: Image that an update takes the place of.
    capacity: U32  #: Largest image, bytes.
    sequence: U32  #: Number of the newest update, 0 if there was none.
    target: Annotated[bytes, "16s"]  #: What the board is, ASCII, zero-padded: part and crystal.


@dataclass(frozen=True, slots=True)
class UpdateStatusRequest(WireRequest[UpdateStatusReply]):
    """Which image of the firmware runs, and where another one would go."""

    TYPE: ClassVar[int] = 0x20


@dataclass(frozen=True, slots=True)
class UpdateBeginRequest(WireRequest[EmptyReply]):
    """Erase the place of the next image; only while the LEDs are dark, and not on trial."""

    TYPE: ClassVar[int] = 0x21
    image: U8  #: Image, as UPDATE_STATUS says.
    length: U32  #: Its bytes.
    crc: U32  #: Their CRC-32/ISO-HDLC.


@dataclass(frozen=True, slots=True)
class UpdateWriteReply(WireMessage):
    """What the board answers to UPDATE_WRITE."""

    offset: U32  #: First byte.
    count: U16  #: Bytes written.


@dataclass(frozen=True, slots=True)
class UpdateWriteRequest(WireRequest[UpdateWriteReply]):
    """Write into the place that was erased."""

    TYPE: ClassVar[int] = 0x22
    offset: U32  #: First byte, a multiple of four.
    data: Rest  #: Content.


@dataclass(frozen=True, slots=True)
class UpdateCommitReply(WireMessage):
    """What the board answers to UPDATE_COMMIT."""

    sequence: U32  #: Number of this update.


@dataclass(frozen=True, slots=True)
class UpdateCommitRequest(WireRequest[UpdateCommitReply]):
    """Check the CRC of what was written; it runs on trial from the next reset on."""

    TYPE: ClassVar[int] = 0x23


@dataclass(frozen=True, slots=True)
class UpdateRestartRequest(WireRequest[EmptyReply]):
    """Reset, a little after the answer; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x24


@dataclass(frozen=True, slots=True)
class UpdateConfirmRequest(WireRequest[EmptyReply]):
    """Keep the image that runs: the trial is over; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x25


#: The reply of each request type.
REPLIES: dict[int, type[WireMessage]] = {
    0x01: HelloReply,
    0x02: ConfigureReply,
    0x03: EmptyReply,
    0x04: WriteReply,
    0x05: ReadReply,
    0x06: CrcReply,
    0x07: CommitReply,
    0x08: EmptyReply,
    0x09: EmptyReply,
    0x0A: EmptyReply,
    0x0B: EmptyReply,
    0x0C: StatusReply,
    0x0D: EmptyReply,
    0x0E: SaveReply,
    0x0F: RecallReply,
    0x10: EmptyReply,
    0x18: StreamReply,
    0x19: PushReply,
    0x1A: EmptyReply,
    0x1B: EmptyReply,
    0x20: UpdateStatusReply,
    0x21: EmptyReply,
    0x22: UpdateWriteReply,
    0x23: UpdateCommitReply,
    0x24: EmptyReply,
    0x25: EmptyReply,
}
