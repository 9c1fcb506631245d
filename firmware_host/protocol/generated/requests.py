"""Messages of the driver board; `python -m firmware_host.protocol.generate` writes this file."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar

from firmware_host.protocol.wire import WireMessage

__all__ = [
    "CHALLENGE_BYTES",
    "CHIP_DARK",
    "CHIP_TEST",
    "CLUSTERS",
    "CRC_BYTES",
    "DEFAULT_BAUD",
    "HEADER_BYTES",
    "KEY_BYTES",
    "KEY_NAME_BYTES",
    "LEDS",
    "MAJOR",
    "MAX_PAYLOAD",
    "MINOR",
    "NO_BANK",
    "NO_SESSION",
    "REPLIES",
    "REPLY_BIT",
    "ROW_BYTES",
    "SEALED",
    "SEAL_BYTES",
    "WINDOW",
    "BlankReply",
    "BlankRequest",
    "BoardFault",
    "Capability",
    "ChipsReply",
    "ChipsRequest",
    "CodebookReply",
    "CodebookRequest",
    "CommitReply",
    "CommitRequest",
    "ConfigureReply",
    "ConfigureRequest",
    "CrcReply",
    "CrcRequest",
    "Format",
    "HelloReply",
    "HelloRequest",
    "KeyReply",
    "KeyRequest",
    "LedTestReply",
    "LedTestRequest",
    "LevelReply",
    "LevelRequest",
    "Profile",
    "PushReply",
    "PushRequest",
    "ReadReply",
    "ReadRequest",
    "RecallReply",
    "RecallRequest",
    "SaveReply",
    "SaveRequest",
    "StartReply",
    "StartRequest",
    "State",
    "Status",
    "StatusReply",
    "StatusRequest",
    "StopReply",
    "StopRequest",
    "StreamReply",
    "StreamRequest",
    "Type",
    "UpdateBeginReply",
    "UpdateBeginRequest",
    "UpdateCommitReply",
    "UpdateCommitRequest",
    "UpdateConfirmReply",
    "UpdateConfirmRequest",
    "UpdateRestartReply",
    "UpdateRestartRequest",
    "UpdateStatusReply",
    "UpdateStatusRequest",
    "UpdateWriteReply",
    "UpdateWriteRequest",
    "Watchdog",
    "WatchdogReply",
    "WatchdogRequest",
    "WriteReply",
    "WriteRequest",
]

MAJOR = 2
"""Version of the protocol: of another major one no message is understood."""
MINOR = 2
"""Version of the protocol: what it has beyond the major version's first."""
HEADER_BYTES = 6
CRC_BYTES = 4
MAX_PAYLOAD = 512
WINDOW = 6
DEFAULT_BAUD = 1000000
CLUSTERS = 16
LEDS = 96
ROW_BYTES = 12
REPLY_BIT = 0x80
"""Set in the type of a reply."""
NO_BANK = 0xFF
"""No bank."""
NO_SESSION = 0x0
"""Session of a HELLO request, and of a board that knows no host."""
SEALED = 0x1
"""Status of a request that ends with a seal."""
SEAL_BYTES = 0x10
"""Length of a seal, at the end of the payload."""
KEY_BYTES = 0x10
"""Length of a board's key."""
CHALLENGE_BYTES = 0x8
"""Length of a session's challenge."""
KEY_NAME_BYTES = 0x4
"""First bytes of a key's SHA-256, which name it."""
CHIP_DARK = 0xFFFFFFFF
"""Chip number in an LED record: output is dark, no chip."""
CHIP_TEST = 0xFFFFFFFE
"""Chip number in an LED record: single-LED test, no chip."""


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

    OK = 0
    """Done."""
    UNKNOWN_TYPE = 1
    """The board does not know this request."""
    BAD_LENGTH = 2
    """The payload has another length than the request's; detail: expected length."""
    OUT_OF_RANGE = 3
    """A value the board cannot take; detail: the nearest value it can."""
    BUSY = 4
    """Not while playing or, for flash, in a LED test; or the bank is playing or about to."""
    BAD_CRC = 5
    """The bank's content has another CRC; detail: the CRC found."""
    FOREIGN_CODEBOOK = 6
    """The codebook's digest is not the one that belongs here."""
    NO_SESSION = 7
    """The board was reset, or another host has said HELLO."""
    STALE = 8
    """Older than a request already done; not done."""
    NOTHING_COMMITTED = 9
    """No bank has been committed."""
    INCOMPATIBLE = 10
    """The host's major version is another one."""
    FLASH_FAULT = 11
    """The flash did not take or give the data."""
    NOT_SUPPORTED = 12
    """This board cannot do that."""
    EMPTY_SLOT = 13
    """No flash slot holds a valid setting."""
    HARDWARE_FAULT = 14
    """A fault holds the LEDs dark; detail: fault bits."""
    NEEDS_KEY = 16
    """The board has a key: what changes something must be sealed with it."""
    BAD_SEAL = 17
    """The seal is of another key, or of another request."""
    TOO_BRIGHT = 15
    """LEDs would be on for longer than the limits allow; detail: the share that they allow, permille."""


class Format(IntEnum):
    """What a bank holds."""

    WORDS = 0
    """Info words u16 [packet][frame][cluster]; the board adds preamble and pilots."""
    MASKS = 1
    """Chip masks, row_bytes a chip, LED 0 the most significant bit of the first byte."""
    CLUSTERS = 2
    """The mask of each cluster, then chips: whole bytes, a bit a cluster, cluster 0 first."""


class Profile(IntEnum):
    """Info-segment profiles of air interface 1."""

    WH4X2 = 0
    """Two words of H_4, 6 bits a symbol."""
    WH8 = 1
    """One word of H_8, 4 bits a symbol."""
    RAW8 = 2
    """Eight plain values, 8 bits a symbol."""
    CUSTOM = 255
    """A codebook the firmware was not built with."""


class State(IntEnum):
    """What the LEDs do."""

    DARK = 0
    """Dark; the chip timer stands."""
    PLAYING = 1
    """Packets of the active bank."""
    STOPPING = 2
    """The last packet before dark."""
    IDLE_PATTERN = 3
    """The idle pattern: LEDs are on for a chip of two, or of more where the limits ask for it."""
    TESTING = 4
    """Single-LED test."""
    FAULT = 5
    """Dark because of a fault."""
    WAITING = 6
    """Dark until the pulse or the clock that START names."""


class Watchdog(IntEnum):
    """What happens when the host falls silent."""

    KEEP = 0
    """Go on playing."""
    IDLE = 1
    """Idle pattern from the next packet boundary until the host sends again."""
    DARK = 2
    """Dark after the packet; START plays again."""


class Capability(IntFlag):
    """Bits of HELLO.capabilities."""

    FLASH = 1
    """SAVE and RECALL."""
    LEVEL = 2
    """LEVEL sets the LED current."""
    TEMPERATURE = 4
    """STATUS.temperature_dc is measured."""
    OPEN_LED = 8
    """STATUS.open_leds is measured."""
    RECORDS = 16
    """LED outputs are recorded (emulators)."""
    TRUST = 64
    """KEY: requests that change something are sealed."""
    STREAM = 32
    """STREAM and PUSH: packets as they come."""
    PULSE = 512
    """START at a pulse of the pulse input, in step with it from then on, or at a clock."""
    UPDATE = 256
    """UPDATE_*: takes another image of its firmware."""


class BoardFault(IntFlag):
    """Bits of STATUS.faults."""

    OVER_TEMPERATURE = 1
    """The drivers are too hot, or the sensor's wire is broken: LEDs dark until they cool and START."""
    OPEN_LED = 2
    """A LED or its wire is open; playing goes on."""
    CLOCK = 4
    """The crystal did not start, or stopped: LEDs dark, timing would be wrong."""
    CHIP_LOST = 8
    """A chip interrupt came a whole chip late, or chips stopped: LEDs dark."""
    WATCHDOG = 16
    """The host fell silent and the watchdog acted; cleared by the next control request."""
    OVER_LIMIT = 32
    """What came next was beyond the limits of light: not shown, LEDs dark until START."""
    UNDERRUN = 64
    """The stream is empty though its end was not announced: idle pattern until the next packet."""
    PULSE = 256
    """No pulse came, or none that fits: the board goes on by its own clock; until the next START."""


@dataclass(frozen=True, slots=True)
class HelloRequest(WireMessage):
    """Open a session and learn the board. Its first two fields never change between versions.

    Attributes:
        major: The host's protocol; another major version is INCOMPATIBLE.
        minor: The host's protocol.
        nonce: Random; the same nonce keeps the session.
    """

    TYPE: ClassVar[int] = 0x01
    LAYOUT: ClassVar[str] = "B B I"

    major: int
    minor: int
    nonce: int


@dataclass(frozen=True, slots=True)
class HelloReply(WireMessage):
    """What the board answers to HELLO.

    Attributes:
        major: The board's protocol.
        minor: The board's protocol: what came later it does not know.
        session: Goes into the header of every further request.
        version_major: Firmware version.
        version_minor: Firmware version.
        version_patch: Firmware version.
        window: Requests the host may have under way.
        max_payload: Largest payload, bytes.
        banks: Number of banks.
        bank_bytes: Size of a bank, bytes.
        clusters: Clusters.
        leds: LEDs.
        tick_hz: Rate of the tick counter that times the chips.
        chip_rate_max_hz: Fastest chip rate.
        level_max_ma: Largest LED current, mA.
        mean_max_ma: Largest mean of a LED's current, mA.
        burst_chips: Chips that a LED may be on beyond its share of any stretch of chips.
        capabilities: Capability bits.
        unique_id: The part's own number.
        uptime_ms: Time since reset; smaller than before means a reset.
        hal: Name of the hardware layer, ASCII, zero-padded.
        clock_hz: Rate of STATUS's clock, nominal.
        challenge: Drawn for the session: seals are over it.
        key_name: First bytes of the SHA-256 of the board's key; zeros without one.
        formats: What a bank may hold, 1 << format; 0: words and masks, in packets of a codebook.
        chip_rate_min_hz: Slowest chip rate.
    """

    TYPE: ClassVar[int] = 0x01
    LAYOUT: ClassVar[str] = "B B H B B B B H B I B H I I H H H I 12s I 12s I 8s 4s H I"
    FIELD_SINCE: ClassVar[dict[str, int]] = {
        "clock_hz": 1,
        "challenge": 1,
        "key_name": 1,
        "formats": 2,
        "chip_rate_min_hz": 2,
    }

    major: int
    minor: int
    session: int
    version_major: int
    version_minor: int
    version_patch: int
    window: int
    max_payload: int
    banks: int
    bank_bytes: int
    clusters: int
    leds: int
    tick_hz: int
    chip_rate_max_hz: int
    level_max_ma: int
    mean_max_ma: int
    burst_chips: int
    capabilities: int
    unique_id: bytes
    uptime_ms: int
    hal: bytes
    clock_hz: int = 0
    challenge: bytes = bytes(8)
    key_name: bytes = bytes(4)
    formats: int = 0
    chip_rate_min_hz: int = 0


@dataclass(frozen=True, slots=True)
class ConfigureRequest(WireMessage):
    """Set what the next COMMIT plays with, playing goes on as it was; and limits of light, that hold at once.

    Attributes:
        chip_rate_hz: Chips per second; must divide the tick rate; not changed while playing.
        profile: Info-segment profile.
        frames: Frames per packet.
        pilot_every: Frames from one pilot to the next; 1: every frame has one.
        level_limit_ma: Largest LED current from now on, mA; 0: as it is.
        duty_limit: Largest share of time that a LED is on from now on, permille; 0: as it is.
    """

    TYPE: ClassVar[int] = 0x02
    LAYOUT: ClassVar[str] = "I B H B H H"

    chip_rate_hz: int
    profile: int
    frames: int
    pilot_every: int
    level_limit_ma: int
    duty_limit: int


@dataclass(frozen=True, slots=True)
class ConfigureReply(WireMessage):
    """What the board answers to CONFIGURE.

    Attributes:
        ticks_per_chip: Length of a chip in ticks.
        packet_chips: Length of a packet in chips.
    """

    TYPE: ClassVar[int] = 0x02
    LAYOUT: ClassVar[str] = "I I"

    ticks_per_chip: int
    packet_chips: int


@dataclass(frozen=True, slots=True)
class CodebookRequest(WireMessage):
    """Set preamble and pilots for the next COMMIT; those of a built-in profile must be the firmware's own.

    Attributes:
        preamble_chips: Chips of the preamble, at most 32.
        preamble: Preamble, first chip on air the most significant of preamble_chips bits.
        pilots: Pilot words, first chip on air the most significant bit.
        digest: SHA-256 of the codebook.
    """

    TYPE: ClassVar[int] = 0x03
    LAYOUT: ClassVar[str] = "B I 16H 32s"

    preamble_chips: int
    preamble: int
    pilots: tuple[int, ...]
    digest: bytes


@dataclass(frozen=True, slots=True)
class CodebookReply(WireMessage):
    """What the board answers to CODEBOOK."""

    TYPE: ClassVar[int] = 0x03
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class WriteRequest(WireMessage):
    """Write into a spare bank; voids what was committed in it.

    Attributes:
        bank: Bank.
        offset: First byte.
        data: Content.
    """

    TYPE: ClassVar[int] = 0x04
    LAYOUT: ClassVar[str] = "B I *"

    bank: int
    offset: int
    data: bytes


@dataclass(frozen=True, slots=True)
class WriteReply(WireMessage):
    """What the board answers to WRITE.

    Attributes:
        bank: Bank.
        offset: First byte.
        count: Bytes written.
    """

    TYPE: ClassVar[int] = 0x04
    LAYOUT: ClassVar[str] = "B I H"

    bank: int
    offset: int
    count: int


@dataclass(frozen=True, slots=True)
class ReadRequest(WireMessage):
    """Read from a bank.

    Attributes:
        bank: Bank.
        offset: First byte.
        count: Bytes wanted.
    """

    TYPE: ClassVar[int] = 0x05
    LAYOUT: ClassVar[str] = "B I H"

    bank: int
    offset: int
    count: int


@dataclass(frozen=True, slots=True)
class ReadReply(WireMessage):
    """What the board answers to READ.

    Attributes:
        bank: Bank.
        offset: First byte.
        data: Content.
    """

    TYPE: ClassVar[int] = 0x05
    LAYOUT: ClassVar[str] = "B I *"

    bank: int
    offset: int
    data: bytes


@dataclass(frozen=True, slots=True)
class CrcRequest(WireMessage):
    """CRC-32/ISO-HDLC of a bank's bytes.

    Attributes:
        bank: Bank.
        offset: First byte.
        length: Bytes.
    """

    TYPE: ClassVar[int] = 0x06
    LAYOUT: ClassVar[str] = "B I I"

    bank: int
    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class CrcReply(WireMessage):
    """What the board answers to CRC.

    Attributes:
        crc: CRC of the bytes.
    """

    TYPE: ClassVar[int] = 0x06
    LAYOUT: ClassVar[str] = "I"

    crc: int


@dataclass(frozen=True, slots=True)
class CommitRequest(WireMessage):
    """Check a bank; play it from the next packet boundary, or, if the check fails, go on with the old one.

    Attributes:
        bank: Bank.
        format: What the bank holds.
        packets: Packets in the bank.
        length: Bytes in the bank.
        crc: CRC-32 of those bytes.
        digest: Digest of the codebook the content was made with.
    """

    TYPE: ClassVar[int] = 0x07
    LAYOUT: ClassVar[str] = "B B H I I 32s"

    bank: int
    format: int
    packets: int
    length: int
    crc: int
    digest: bytes


@dataclass(frozen=True, slots=True)
class CommitReply(WireMessage):
    """What the board answers to COMMIT.

    Attributes:
        commits: Commits accepted since reset.
    """

    TYPE: ClassVar[int] = 0x07
    LAYOUT: ClassVar[str] = "I"

    commits: int


@dataclass(frozen=True, slots=True)
class StartRequest(WireMessage):
    """Play the active bank from its first packet; nothing happens if it plays.

    Attributes:
        at_pulse: Begin at this pulse, as STATUS counts them, and keep in step; 0: not.
        pulse_hz: Pulses a second; must divide the chip rate.
        at_clock: Without a pulse: begin when STATUS's clock stands here; 0: at once.
    """

    TYPE: ClassVar[int] = 0x08
    LAYOUT: ClassVar[str] = "I H I"
    FIELD_SINCE: ClassVar[dict[str, int]] = {"at_pulse": 1, "pulse_hz": 1, "at_clock": 1}

    at_pulse: int = 0
    pulse_hz: int = 0
    at_clock: int = 0


@dataclass(frozen=True, slots=True)
class StartReply(WireMessage):
    """What the board answers to START."""

    TYPE: ClassVar[int] = 0x08
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class StopRequest(WireMessage):
    """Finish the packet, then dark; a stream ends, and what waits in it is dropped."""

    TYPE: ClassVar[int] = 0x09
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class StopReply(WireMessage):
    """What the board answers to STOP."""

    TYPE: ClassVar[int] = 0x09
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class BlankRequest(WireMessage):
    """Dark at once, within the packet."""

    TYPE: ClassVar[int] = 0x0A
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class BlankReply(WireMessage):
    """What the board answers to BLANK."""

    TYPE: ClassVar[int] = 0x0A
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class LevelRequest(WireMessage):
    """Set the LED current; refused above its limit, or if what is committed were too bright.

    Attributes:
        level_ma: LED current, mA.
    """

    TYPE: ClassVar[int] = 0x0B
    LAYOUT: ClassVar[str] = "H"

    level_ma: int


@dataclass(frozen=True, slots=True)
class LevelReply(WireMessage):
    """What the board answers to LEVEL."""

    TYPE: ClassVar[int] = 0x0B
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class StatusRequest(WireMessage):
    """What the board does, and what went wrong since reset."""

    TYPE: ClassVar[int] = 0x0C
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class StatusReply(WireMessage):
    """What the board answers to STATUS.

    Attributes:
        state: State.
        faults: Fault bits.
        active_bank: Bank that plays or would play, or no_bank.
        pending_bank: Bank waiting for the packet boundary, or no_bank.
        format: Format of the active bank.
        profile: Profile of the active bank.
        frames: Frames per packet of the active bank.
        pilot_every: Frames from one of its pilots to the next.
        packets: Packets in the active bank.
        length: Bytes in the active bank.
        crc: CRC-32 of the active bank.
        chip_rate_hz: Chips per second, as configured.
        commits: Commits accepted since reset.
        packets_sent: Packets played to their end since reset.
        chips_sent: Chips since reset.
        lateness_ticks: Delay of the latest chip.
        lateness_max_ticks: Largest delay since START.
        crc_errors: Datagrams with a wrong CRC.
        framing_errors: Datagrams too short, too long or no COBS.
        overflow_errors: Bytes lost because the receive buffer was full.
        requests: Good datagrams received.
        level_ma: LED current, mA.
        level_limit_ma: Largest LED current that LEVEL takes, mA.
        duty_limit: Largest share of time that a LED may be on, permille; with a large LED current less.
        duty: Share of time that the active bank has a LED on, that of the brightest, permille.
        temperature_dc: Driver temperature, 0.1 degree C.
        open_leds: A bit a LED: open.
        watchdog: Watchdog action.
        watchdog_ms: Watchdog time-out.
        silence_ms: Time since the request before this one, HELLO left out.
        uptime_ms: Time since reset.
        digest: Digest of the active bank's codebook, or of the one set.
        underruns: How often the active bank's stream was empty before its end was announced.
        clock: The board's clock, which counts freely and wraps.
        pulses: Pulses of the pulse input since reset.
        pulse_clocks: Clocks from the pulse before to the latest; 0: unknown.
        packet_chips: Length of a packet of the active bank, in chips of the chip rate.
        hold: How many of these a chip of the bank lasts; 0: the bank is of a codebook.
        clusters: Clusters of the active bank's masks; 0 without these.
    """

    TYPE: ClassVar[int] = 0x0C
    LAYOUT: ClassVar[str] = (
        "B H B B B B H B H I I I I I I I I I I I I H H H H h 12s B I I I 32s I I I I I B B"
    )
    FIELD_SINCE: ClassVar[dict[str, int]] = {
        "clock": 1,
        "pulses": 1,
        "pulse_clocks": 1,
        "packet_chips": 2,
        "hold": 2,
        "clusters": 2,
    }

    state: int
    faults: int
    active_bank: int
    pending_bank: int
    format: int
    profile: int
    frames: int
    pilot_every: int
    packets: int
    length: int
    crc: int
    chip_rate_hz: int
    commits: int
    packets_sent: int
    chips_sent: int
    lateness_ticks: int
    lateness_max_ticks: int
    crc_errors: int
    framing_errors: int
    overflow_errors: int
    requests: int
    level_ma: int
    level_limit_ma: int
    duty_limit: int
    duty: int
    temperature_dc: int
    open_leds: bytes
    watchdog: int
    watchdog_ms: int
    silence_ms: int
    uptime_ms: int
    digest: bytes
    underruns: int
    clock: int = 0
    pulses: int = 0
    pulse_clocks: int = 0
    packet_chips: int = 0
    hold: int = 0
    clusters: int = 0


@dataclass(frozen=True, slots=True)
class WatchdogRequest(WireMessage):
    """What to do when the host falls silent.

    Attributes:
        action: Watchdog action.
        timeout_ms: Silence before it acts, at least 100 ms.
    """

    TYPE: ClassVar[int] = 0x0D
    LAYOUT: ClassVar[str] = "B I"

    action: int
    timeout_ms: int


@dataclass(frozen=True, slots=True)
class WatchdogReply(WireMessage):
    """What the board answers to WATCHDOG."""

    TYPE: ClassVar[int] = 0x0D
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class SaveRequest(WireMessage):
    """Save active bank and settings to the older of two flash slots; only while the LEDs are dark.

    Attributes:
        autostart: 1: recall and play after a reset.
    """

    TYPE: ClassVar[int] = 0x0E
    LAYOUT: ClassVar[str] = "B"

    autostart: int


@dataclass(frozen=True, slots=True)
class SaveReply(WireMessage):
    """What the board answers to SAVE.

    Attributes:
        slot: Slot written.
        save_sequence: Its sequence number.
    """

    TYPE: ClassVar[int] = 0x0E
    LAYOUT: ClassVar[str] = "B I"

    slot: int
    save_sequence: int


@dataclass(frozen=True, slots=True)
class RecallRequest(WireMessage):
    """Commit what the newest valid flash slot holds; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x0F
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class RecallReply(WireMessage):
    """What the board answers to RECALL.

    Attributes:
        slot: Slot read.
        save_sequence: Its sequence number.
    """

    TYPE: ClassVar[int] = 0x0F
    LAYOUT: ClassVar[str] = "B I"

    slot: int
    save_sequence: int


@dataclass(frozen=True, slots=True)
class LedTestRequest(WireMessage):
    """Walk over LEDs one by one, at their mean current at most; not while playing. STOP or BLANK ends it.

    Attributes:
        first: First LED.
        last: Last LED.
        dwell_ms: Time a LED is on, at least 1 ms.
    """

    TYPE: ClassVar[int] = 0x10
    LAYOUT: ClassVar[str] = "B B H"

    first: int
    last: int
    dwell_ms: int


@dataclass(frozen=True, slots=True)
class LedTestReply(WireMessage):
    """What the board answers to LED_TEST."""

    TYPE: ClassVar[int] = 0x10
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class StreamRequest(WireMessage):
    """Make a spare bank an empty queue of packets and play from it; idle pattern while it is empty.

    Attributes:
        bank: Bank.
        format: What a packet holds.
        digest: Digest of the codebook that packets are made with.
    """

    TYPE: ClassVar[int] = 0x18
    LAYOUT: ClassVar[str] = "B B 32s"

    bank: int
    format: int
    digest: bytes


@dataclass(frozen=True, slots=True)
class StreamReply(WireMessage):
    """What the board answers to STREAM.

    Attributes:
        slots: Packets that the queue holds, the one that plays among them.
    """

    TYPE: ClassVar[int] = 0x18
    LAYOUT: ClassVar[str] = "H"

    slots: int


@dataclass(frozen=True, slots=True)
class PushRequest(WireMessage):
    """Put a piece of a packet into the queue, if it is the next and there is room; the reply says what is.

    Attributes:
        bank: Bank.
        number: Number of the packet, from 0 on.
        offset: First byte.
        last: 1: no further packet comes, dark after what is there; 0: playing goes on.
        data: Content.
    """

    TYPE: ClassVar[int] = 0x19
    LAYOUT: ClassVar[str] = "B I H B *"

    bank: int
    number: int
    offset: int
    last: int
    data: bytes


@dataclass(frozen=True, slots=True)
class PushReply(WireMessage):
    """What the board answers to PUSH.

    Attributes:
        number: Number of the packet that is next: those before it are there.
        offset: Bytes of it that are there.
        begun: Packets that have begun to play.
        underruns: How often the queue was empty before its end was announced.
    """

    TYPE: ClassVar[int] = 0x19
    LAYOUT: ClassVar[str] = "I H I I"

    number: int
    offset: int
    begun: int
    underruns: int


@dataclass(frozen=True, slots=True)
class KeyRequest(WireMessage):
    """Set the key that requests which change something are sealed with; SAVE keeps it.

    Attributes:
        key: The key; zeros for none.
    """

    TYPE: ClassVar[int] = 0x1A
    LAYOUT: ClassVar[str] = "16s"
    SINCE: ClassVar[int] = 1

    key: bytes


@dataclass(frozen=True, slots=True)
class KeyReply(WireMessage):
    """What the board answers to KEY."""

    TYPE: ClassVar[int] = 0x1A
    LAYOUT: ClassVar[str] = ""
    SINCE: ClassVar[int] = 1


@dataclass(frozen=True, slots=True)
class ChipsRequest(WireMessage):
    """Set packets of chips alone for the next COMMIT or STREAM, in place of a codebook.

    Attributes:
        packet_chips: Chips of a packet in the bank.
        hold: How many chips of the chip rate each of them lasts, from 1 on.
        clusters: Clusters of the format CLUSTERS; 0: MASKS only.
        digest: SHA-256 of what chips mean, which COMMIT repeats.
    """

    TYPE: ClassVar[int] = 0x1B
    LAYOUT: ClassVar[str] = "I B B 32s"
    SINCE: ClassVar[int] = 2

    packet_chips: int
    hold: int
    clusters: int
    digest: bytes


@dataclass(frozen=True, slots=True)
class ChipsReply(WireMessage):
    """What the board answers to CHIPS."""

    TYPE: ClassVar[int] = 0x1B
    LAYOUT: ClassVar[str] = ""
    SINCE: ClassVar[int] = 2


@dataclass(frozen=True, slots=True)
class UpdateStatusRequest(WireMessage):
    """Which image of the firmware runs, and where another one would go."""

    TYPE: ClassVar[int] = 0x20
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class UpdateStatusReply(WireMessage):
    """What the board answers to UPDATE_STATUS.

    Attributes:
        running: Image that runs: 0 the one that was flashed, 1 or 2 one that came by an update.
        trial: 1: it runs on trial, and is left at the third reset unless it is confirmed.
        next: Image that an update takes the place of.
        capacity: Largest image, bytes.
        sequence: Number of the newest update, 0 if there was none.
        target: What the board is, ASCII, zero-padded: part and crystal.
    """

    TYPE: ClassVar[int] = 0x20
    LAYOUT: ClassVar[str] = "B B B I I 16s"

    running: int
    trial: int
    next: int
    capacity: int
    sequence: int
    target: bytes


@dataclass(frozen=True, slots=True)
class UpdateBeginRequest(WireMessage):
    """Erase the place of the next image; only while the LEDs are dark, and not on trial.

    Attributes:
        image: Image, as UPDATE_STATUS says.
        length: Its bytes.
        crc: Their CRC-32/ISO-HDLC.
    """

    TYPE: ClassVar[int] = 0x21
    LAYOUT: ClassVar[str] = "B I I"

    image: int
    length: int
    crc: int


@dataclass(frozen=True, slots=True)
class UpdateBeginReply(WireMessage):
    """What the board answers to UPDATE_BEGIN."""

    TYPE: ClassVar[int] = 0x21
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class UpdateWriteRequest(WireMessage):
    """Write into the place that was erased.

    Attributes:
        offset: First byte, a multiple of four.
        data: Content.
    """

    TYPE: ClassVar[int] = 0x22
    LAYOUT: ClassVar[str] = "I *"

    offset: int
    data: bytes


@dataclass(frozen=True, slots=True)
class UpdateWriteReply(WireMessage):
    """What the board answers to UPDATE_WRITE.

    Attributes:
        offset: First byte.
        count: Bytes written.
    """

    TYPE: ClassVar[int] = 0x22
    LAYOUT: ClassVar[str] = "I H"

    offset: int
    count: int


@dataclass(frozen=True, slots=True)
class UpdateCommitRequest(WireMessage):
    """Check the CRC of what was written; it runs on trial from the next reset on."""

    TYPE: ClassVar[int] = 0x23
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class UpdateCommitReply(WireMessage):
    """What the board answers to UPDATE_COMMIT.

    Attributes:
        sequence: Number of this update.
    """

    TYPE: ClassVar[int] = 0x23
    LAYOUT: ClassVar[str] = "I"

    sequence: int


@dataclass(frozen=True, slots=True)
class UpdateRestartRequest(WireMessage):
    """Reset, a little after the answer; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x24
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class UpdateRestartReply(WireMessage):
    """What the board answers to UPDATE_RESTART."""

    TYPE: ClassVar[int] = 0x24
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class UpdateConfirmRequest(WireMessage):
    """Keep the image that runs: the trial is over; only while the LEDs are dark."""

    TYPE: ClassVar[int] = 0x25
    LAYOUT: ClassVar[str] = ""


@dataclass(frozen=True, slots=True)
class UpdateConfirmReply(WireMessage):
    """What the board answers to UPDATE_CONFIRM."""

    TYPE: ClassVar[int] = 0x25
    LAYOUT: ClassVar[str] = ""


REPLIES: dict[int, type[WireMessage]] = {
    0x01: HelloReply,
    0x02: ConfigureReply,
    0x03: CodebookReply,
    0x04: WriteReply,
    0x05: ReadReply,
    0x06: CrcReply,
    0x07: CommitReply,
    0x08: StartReply,
    0x09: StopReply,
    0x0A: BlankReply,
    0x0B: LevelReply,
    0x0C: StatusReply,
    0x0D: WatchdogReply,
    0x0E: SaveReply,
    0x0F: RecallReply,
    0x10: LedTestReply,
    0x18: StreamReply,
    0x19: PushReply,
    0x1A: KeyReply,
    0x1B: ChipsReply,
    0x20: UpdateStatusReply,
    0x21: UpdateBeginReply,
    0x22: UpdateWriteReply,
    0x23: UpdateCommitReply,
    0x24: UpdateRestartReply,
    0x25: UpdateConfirmReply,
}
"""The reply of each request type."""
