"""A driver board: program it, start and stop it, read its state."""

import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from evlcp_sdk.air.codebook import word_of_chips
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.signals import Stopped, never_stop
from firmware_host.board.bank import PREAMBLE_CHIPS, WORD_CHIPS, Bank, make_queue
from firmware_host.board.session import Session
from firmware_host.board.stream import DEFAULT_AHEAD, Stream
from firmware_host.board.tables import enum_name
from firmware_host.errors import IncompatibleError, LineError, RefusedError, VerifyError
from firmware_host.protocol.client import RequestOutcome
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.profiles import DIGESTS
from firmware_host.protocol.generated.requests import (
    CLUSTERS,
    LEDS,
    NO_BANK,
    Capability,
    Format,
    Profile,
    State,
    Status,
    Watchdog,
)

_BLOCK_BYTES = 2048
"""Bytes of a bank that are compared by one CRC."""

_MAX_HOLD = 255
"""Most times that a board repeats a chip."""

_SMALLEST_PIECE_BYTES = 32
"""Smallest piece that is tried on a noisy line."""

Progress = Callable[[float, float], None]
"""Called with the amount done and that in all, bytes or seconds."""


@dataclass(frozen=True)
class ProgramResult:
    """The result of programming.

    Attributes:
        written: Bytes sent into the bank; 0 if it had them all.
        length: Bytes of the payload.
        swapped: Whether another bank became active.
        bank: The active bank.
        retries: Number of requests that were sent again.
        watchdog: What the board does when this host falls silent: keep, idle or dark.
        watchdog_ms: Silence after which it does so, ms.
    """

    written: int
    length: int
    swapped: bool
    bank: int
    retries: int
    watchdog: str
    watchdog_ms: int


@dataclass(frozen=True)
class Settings:
    """A board's settings besides its bank.

    Attributes:
        level_ma: LED current, mA; None leaves it.
        watchdog: What to do when the host falls silent; None leaves it.
        watchdog_ms: Silence after which it is done, ms.
        start: Whether to play at the end.
        level_limit_ma: Largest LED current from now on, mA; None leaves it.
        duty_limit: Largest share of time that a LED is on from now on, 0.001 to 1; None leaves it.

    Raises:
        ConfigError: A limit is out of its range.
    """

    level_ma: Annotated[int, Field(ge=0, le=65535)] | None = None
    watchdog: Literal["keep", "idle", "dark"] | None = None
    watchdog_ms: Annotated[int, Field(ge=100, le=2**32 - 1)] = 5_000
    start: bool = True
    level_limit_ma: int | None = None
    duty_limit: float | None = None

    def __post_init__(self) -> None:
        if self.level_limit_ma is not None and not 0 < self.level_limit_ma < 1 << 16:
            raise ConfigError(f"level_limit_ma = {self.level_limit_ma}: expected 1 to 65535")
        if self.duty_limit is not None and not 0.001 <= self.duty_limit <= 1:
            raise ConfigError(f"duty_limit = {self.duty_limit}: expected 0.001 to 1")


class Board:
    """The board at the other end of a line, which is greeted with HELLO at once.

    Attributes:
        session: The session.
        info: The board's answer to HELLO.

    Raises:
        NoBoardError: Nobody answers.
        IncompatibleError: The board speaks another protocol.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.info: protocol.HelloReply = session.hello()

    # -- single requests

    def status(self) -> protocol.StatusReply:
        """The board's state."""
        return self.session.call(protocol.StatusRequest())

    def start(self, at_pulse: int = 0, pulse_hz: int = 1, at_clock: int = 0) -> None:
        """Play the active bank: now, at a pulse and from then on in step with the pulses, or at a clock.

        Pulse and clock count as in STATUS; 0 is none.
        """
        self.session.call(protocol.StartRequest(at_pulse, pulse_hz if at_pulse else 0, at_clock))

    def stop(self) -> None:
        """Go dark after the packet; a stream ends, and its waiting packets are dropped."""
        self.session.call(protocol.StopRequest())

    def blank(self) -> None:
        """Go dark at once."""
        self.session.call(protocol.BlankRequest())

    def set_level(self, level_ma: int) -> None:
        """Set the LED current, mA.

        Raises:
            RefusedError: It is above the board's maximum.
        """
        self.session.call(protocol.LevelRequest(level_ma))

    def set_watchdog(self, action: Watchdog, timeout_ms: int) -> None:
        """Set what the board does when the host is silent for `timeout_ms`."""
        self.session.call(protocol.WatchdogRequest(action, timeout_ms))

    def save(self, autostart: bool = False) -> protocol.SaveReply:
        """Save active bank and settings to flash; with `autostart` the board plays them after a reset."""
        return self.session.call(protocol.SaveRequest(int(autostart)))

    def recall(self) -> protocol.RecallReply:
        """Commit the saved bank and settings."""
        return self.session.call(protocol.RecallRequest())

    def test_leds(self, first: int, last: int, dwell_ms: int) -> None:
        """Light LEDs one by one."""
        self.session.call(protocol.LedTestRequest(first, last, dwell_ms))

    def set_key(self, key: bytes | None) -> None:
        """Set the board's key, or remove it; a new session begins, and SAVE keeps the key.

        Raises:
            IncompatibleError: The board has no random numbers, which keys need, or no keys.
            RefusedError: It has a key, and this host does not.
        """
        if not self.info.capabilities & Capability.TRUST:
            raise IncompatibleError(f"{self.session.name}: cannot have a key; see 'evlcp board hello'")
        self.session.call(protocol.KeyRequest(key or bytes(protocol.KEY_BYTES)))
        self.session.key = key
        self.info = self.session.renew()

    def read_crc(self, bank: int, offset: int, length: int) -> int:
        """CRC-32 of a bank's bytes."""
        return self.session.call(protocol.CrcRequest(bank, offset, length)).crc

    def read_bank(self, bank: int, offset: int, length: int) -> bytes:
        """A bank's bytes."""
        most = self.session.max_payload - protocol.ReadReply.min_bytes()
        end, found = offset + length, list[tuple[int, bytes]]()
        reads = (protocol.ReadRequest(bank, at, min(most, end - at)) for at in range(offset, end, most))
        self.session.call_each(reads, lambda _, reply: found.append((reply.offset, reply.data)))
        data = b"".join(piece for _, piece in sorted(found))
        if len(data) != length:
            raise LineError(f"{self.session.name}: READ gave {len(data)} bytes, expected {length}; try again")
        return data

    # -- programming

    def set_limits(self, bank: Bank, level_ma: int | None = None, duty: float | None = None) -> None:
        """Set the light limits, valid at once, and chip rate and profile for the next commit.

        Args:
            bank: The next bank.
            level_ma: Largest LED current, mA; None leaves it.
            duty: Largest share of time that a LED is on, 0.001 to 1; None leaves it.

        Raises:
            RefusedError: The board cannot take a value, or plays something brighter; nothing is changed.
        """
        if duty is not None:
            status = self.status()
            if status.active_bank != NO_BANK:
                self.check_duty("what is programmed", status.duty, duty)
        self._configure(self.adapt_bank(bank), level_ma or 0, 0 if duty is None else round(1000 * duty))

    def check_duty(self, what: str, permille: int, limit: float) -> None:
        """Raise RefusedError if `what` has a LED on for a larger share of time than a limit."""
        if permille > round(1000 * limit):
            raise RefusedError(
                f"{self.session.name}: {what} has a LED on for {permille / 1000:g} of the time, the duty"
                f" limit is {limit:g}: give a limit of at least {permille / 1000:g}, or program chips that"
                " are dark more often; nothing was changed",
                Status.TOO_BRIGHT,
                round(1000 * limit),
            )

    def prepare_commit(self, bank: Bank) -> None:
        """Set chip rate, profile and codebook, or the chips of a packet, for the next commit.

        Raises:
            IncompatibleError: The firmware was built with another codebook, or plays no chips without one.
            RefusedError: The board cannot take a value.
        """
        self._configure(bank)
        if not bank.composed:
            clusters = bank.clusters if bank.format == Format.CLUSTERS else 0
            sizes = (bank.link.packet.packet_chips, self._hold_count(bank), clusters)
            self.session.call(protocol.ChipsRequest(*sizes, bank.digest))
            return
        pilots = struct.pack(f"<{CLUSTERS}H", *map(word_of_chips, bank.link.codebook.pilots))
        preamble = (bank.link.packet.preamble_chips, word_of_chips(bank.link.codebook.preamble))
        self.session.call(protocol.CodebookRequest(*preamble, pilots, bank.digest))

    def _hold_count(self, bank: Bank) -> int:
        """Times that the board repeats a chip of the bank; above 1 if these are longer than its longest."""
        info, rate = self.info, bank.chip_rate_hz
        if not bank.composed:
            for hold in range(1, min(_MAX_HOLD, info.chip_rate_max_hz // rate) + 1):
                if rate * hold >= info.chip_rate_min_hz and info.tick_hz % (rate * hold) == 0:
                    return hold
        return 1

    def adapt_bank(self, bank: Bank) -> Bank:
        """The bank in a format that this board can play.

        A board that repeats each chip of a slow link does not compose packets, and gets every chip.
        """
        slow = bank.composed and bank.chip_rate_hz < self.info.chip_rate_min_hz
        return bank.to_chip_format() if slow else bank

    def _configure(self, bank: Bank, level_limit_ma: int = 0, duty_limit: int = 0) -> None:
        info, rate = self.info, bank.chip_rate_hz * self._hold_count(bank)
        packet = (bank.link.packet.frames, bank.link.packet.pilot_every) if bank.composed else (1, 1)
        limits = (level_limit_ma, duty_limit)
        try:
            self.session.call(protocol.ConfigureRequest(rate, profile_number(bank), *packet, *limits))
        except RefusedError as fault:
            # the board checks the chip rate first
            wrong = not info.chip_rate_min_hz <= rate <= info.chip_rate_max_hz or info.tick_hz % rate
            if fault.status != Status.OUT_OF_RANGE or not wrong:
                raise
            least = f"at least {info.chip_rate_min_hz}, " if info.chip_rate_min_hz else ""
            raise RefusedError(
                f"{self.session.name}: no chip rate of {rate} Hz: must divide"
                f" {info.tick_hz} Hz, {least}at most {info.chip_rate_max_hz};"
                f" the nearest the board can take is {fault.detail}",
                fault.status,
                fault.detail,
            ) from fault

    def is_active_bank(self, bank: Bank, status: protocol.StatusReply) -> bool:
        """Whether the board's active bank is this one."""
        same = status.active_bank != NO_BANK and status.crc == bank.crc
        return same and self._find_difference(bank, status) is None

    def _find_difference(self, bank: Bank, status: protocol.StatusReply) -> str | None:
        """The first difference between the active bank in STATUS and this one, but for the CRC."""
        packet, hold = bank.link.packet, self._hold_count(bank)
        expected: dict[str, object] = {
            "format": bank.format,
            "packets": bank.packets,
            "length": len(bank.content),
            "chip_rate_hz": bank.chip_rate_hz * hold,
            "profile": profile_number(bank),
            "digest": bank.digest,
        }
        if bank.composed:
            expected |= {"hold": 0, "frames": packet.frames, "pilot_every": packet.pilot_every}
        else:
            clusters = bank.clusters if bank.format == Format.CLUSTERS else 0
            expected |= {"hold": hold, "packet_chips": hold * packet.packet_chips, "clusters": clusters}
        for name, value in expected.items():
            if getattr(status, name) != value:
                return f"{name} = {getattr(status, name)}, expected {value}"
        return None

    def program(
        self, content: Bank, verify: bool = True, progress: Progress = lambda *_: None
    ) -> ProgramResult:
        """Write a bank's content to the board and activate it; blocks that the board has are not sent.

        A board that plays goes on with the old bank until the new one is complete and checked, and swaps
        between two packets.

        Raises:
            ConfigError: The content is larger than a bank, or its clusters are not the board's.
            RefusedError: The board refuses a value, or plays at another chip rate; then nothing is sent.
            VerifyError: The bank does not hold what was sent.
            LineError: The line fails; the active bank stays.
        """
        content = self.adapt_bank(content)
        self.check_fits(content)
        retries, total, written = self.session.client.retries, len(content.content), 0
        status = self._wait_until_swapped()
        swapped = not self.is_active_bank(content, status)
        if swapped:
            self._check_rate(content, status)
            self.prepare_commit(content)
            bank = 1 if status.active_bank == 0 else 0
            written = self.write_missing(bank, content.content, progress)
            if verify and written and self.read_crc(bank, 0, total) != content.crc:
                raise VerifyError(
                    f"{self.session.name}: bank {bank} does not hold what was sent; the old one goes on;"
                    " program it again, and if that does not help have the board looked at"
                )
            sizes = (content.format, content.packets, total, content.crc)
            self.session.call(protocol.CommitRequest(bank, *sizes, content.digest))
            status = self._wait_until_swapped()
            if verify and not self.is_active_bank(content, status):
                raise VerifyError(
                    f"{self.session.name}: bank {status.active_bank} is active, expected {bank};"
                    " program it again"
                )
        else:
            progress(total, total)
        return ProgramResult(
            written=written,
            length=total,
            swapped=swapped,
            bank=status.active_bank,
            retries=self.session.client.retries - retries,
            watchdog=enum_name(Watchdog, status.watchdog),
            watchdog_ms=status.watchdog_ms,
        )

    def stream(self, link: Link, ahead: int = DEFAULT_AHEAD) -> Stream:
        """Make the spare bank a queue of packets, and play from it.

        The board swaps to it between two packets, and shows its idle pattern while the queue is empty. If the
        link's framing determines the LEDs' state while nothing is sent, the queue is kept filled with it.

        Args:
            link: The packets' link.
            ahead: Packets on the board, the playing one included: they determine a packet's delay, and how
                long the host may stall.

        Raises:
            ConfigError: The board cannot play the link, or `ahead` is less than 2.
            IncompatibleError: The firmware has no streams, or another codebook, or does not play such links.
            RefusedError: The board refuses a value, or plays at another chip rate.
        """
        if ahead < 2:
            raise ConfigError(f"ahead = {ahead}, expected 2 or more packets: one plays, the next waits")
        like = self.adapt_bank(make_queue(link))
        if not self.info.capabilities & Capability.STREAM:
            raise IncompatibleError(f"{self.session.name}: its firmware has no streams; update the firmware")
        self.check_fits(like)
        slots = (self.info.bank_bytes - len(like.table)) // like.packet_bytes
        self._check_ahead(ahead, slots)
        status = self._wait_until_swapped()
        self._check_rate(like, status)
        if like.rest:
            share = min(status.duty_limit / 1000, self.info.mean_max_ma / max(1, status.level_ma))
            self.check_duty("a pause of this link", 1000, min(1.0, share))
        self.prepare_commit(like)
        bank = 1 if status.active_bank == 0 else 0
        self.write_missing(bank, like.content)
        slots = self.session.call(protocol.StreamRequest(bank, like.format, like.digest)).slots
        if ahead >= slots:
            self.stop()
        self._check_ahead(ahead, slots)
        pulse_s = 0.5 if status.watchdog == Watchdog.KEEP else min(0.5, max(100, status.watchdog_ms) / 3e3)
        stream = Stream(self.session, bank, like, ahead, pulse_s)
        if status.state != State.PLAYING:
            self.start()
        return stream

    def _check_ahead(self, ahead: int, slots: int) -> None:
        if ahead >= slots:
            raise ConfigError(
                f"ahead = {ahead}, {self.session.name} holds {slots - 1} packets of this length"
            )

    def _check_rate(self, content: Bank, status: protocol.StatusReply) -> None:
        rate_hz = content.chip_rate_hz * self._hold_count(content)
        runs = status.state in (State.PLAYING, State.STOPPING, State.IDLE_PATTERN)
        if runs and status.chip_rate_hz != rate_hz:
            raise RefusedError(
                f"{self.session.name}: plays {status.chip_rate_hz} chips per second, this payload has"
                f" {rate_hz}: a board that plays keeps its rate; 'evlcp board stop' first;"
                " nothing was sent",
                Status.BUSY,
                status.chip_rate_hz,
            )

    def check_same_air(self, bank: Bank, status: protocol.StatusReply) -> None:
        """Raise IncompatibleError unless the bank has the codebook and chip rate of the active one."""
        rate_hz = status.chip_rate_hz // max(1, status.hold)
        if (status.digest, rate_hz) != (bank.digest, bank.chip_rate_hz):
            raise IncompatibleError(
                f"{self.session.name}: plays codebook {status.digest.hex()[:16]} at {rate_hz} chips per"
                f" second, this payload's link has {bank.digest.hex()[:16]} ({bank.link.codebook.profile}) at"
                f" air.chip_rate_hz = {bank.chip_rate_hz}; give its link with -c or --set, or 'evlcp board"
                " program' to change it"
            )

    def verify(self, bank: Bank) -> int:
        """Read the active bank back and compare it; return its number.

        Raises:
            IncompatibleError: It has another codebook or chip rate.
            VerifyError: It holds something else.
        """
        bank, s, name = self.adapt_bank(bank), self.status(), self.session.name
        advice = "'evlcp board program' brings it there"
        if s.active_bank == NO_BANK:
            raise VerifyError(f"{name}: nothing is programmed; {advice}")
        if not s.length:
            raise VerifyError(
                f"{name}: its bank is the queue of a stream, which holds nothing to compare; {advice}"
            )
        self.check_same_air(bank, s)
        difference = self._find_difference(bank, s)
        if difference is not None:
            raise VerifyError(f"{name}: holds other packets: {difference}; {advice}")
        held = self.read_bank(s.active_bank, 0, s.length)
        wrong = next((i for i, (a, b) in enumerate(zip(held, bank.content, strict=True)) if a != b), None)
        if wrong is not None:
            raise VerifyError(
                f"{name}: byte {wrong} of bank {s.active_bank} is {held[wrong]:#04x},"
                f" expected {bank.content[wrong]:#04x}; {advice}"
            )
        return s.active_bank

    def check_fits(self, bank: Bank) -> None:
        """Raise ConfigError unless the content fits the board's LEDs, formats and bank by its HELLO.

        Raises:
            IncompatibleError: Its firmware does not play such links.
        """
        info, name, leds = self.info, self.session.name, len(bank.link.bar.led_clusters())
        if leds > info.leds:
            raise ConfigError(f"a link of {leds} LEDs, {name} has {info.leds}: HELLO says so")
        if bank.composed and (info.leds, info.clusters) != (LEDS, CLUSTERS):
            raise ConfigError(
                f"packets of {CLUSTERS} clusters and {LEDS} LEDs, {name} has {info.clusters}"
                f" and {info.leds}: HELLO says so"
            )
        if not bank.composed and not info.formats >> bank.format & 1:
            raise IncompatibleError(
                f"{name}: its firmware (protocol {info.major}.{info.minor}) plays packets that it composes"
                f" alone: of {LEDS} LEDs in {CLUSTERS} equal clusters, codes of {WORD_CHIPS} chips, a"
                f" preamble of at most {PREAMBLE_CHIPS}; update the firmware"
            )
        room = max(0, info.bank_bytes - len(bank.table))
        what = f"a bank of {name} has {info.bank_bytes}" + (
            f", {len(bank.table)} of them for the clusters" if len(bank.table) else ""
        )
        # a stream needs room for the playing packet and the next one
        queue = not bank.packets
        if bank.packet_bytes * (2 if queue else 1) > room:
            words = bank.format == Format.WORDS
            unit_bytes, unit = (2 * CLUSTERS, "frames") if words else (bank.chip_bytes, "chips")
            raise ConfigError(
                f"a packet of {bank.packet_bytes // unit_bytes} {unit} takes {bank.packet_bytes} bytes,"
                f" {what}: {'a stream needs room for two' if queue else 'not one fits'};"
                f" a packet may have at most {(room // 2 if queue else room) // unit_bytes} {unit}"
            )
        if bank.packet_bytes * bank.packets > room:
            raise ConfigError(
                f"{bank.packets} packets of {bank.packet_bytes} bytes, {what}:"
                f" send at most {room // bank.packet_bytes} packets"
            )

    def write_missing(self, bank: int, content: bytes, progress: Progress = lambda *_: None) -> int:
        """Write the blocks that a spare bank lacks; return the bytes written.

        On a noisy line a piece that gets no answer is halved.

        Raises:
            LineError: Even the smallest piece gets no answer.
        """
        missing = self._find_missing(bank, content)
        total = sum(n for _, n in missing)
        done = len(content) - total
        progress(done, len(content))
        piece_bytes = self.session.max_payload - protocol.WriteRequest.min_bytes()
        queue = deque((at, at + n) for at, n in missing)

        def requests() -> Iterator[protocol.WriteRequest]:
            while queue:
                at, end = queue.popleft()
                if end - at > piece_bytes:
                    queue.appendleft((at + piece_bytes, end))
                    end = at + piece_bytes
                yield protocol.WriteRequest(bank, at, content[at:end])

        def handle(request: protocol.WriteRequest, outcome: RequestOutcome) -> None:
            nonlocal piece_bytes, done
            n = len(request.data)
            if outcome.status is None and n > _SMALLEST_PIECE_BYTES:
                piece_bytes = max(_SMALLEST_PIECE_BYTES, min(piece_bytes, n // 2))
                queue.append((request.offset, request.offset + n))
                return
            self.session.expect_reply(request, outcome)
            done += n
            progress(done, len(content))

        while queue:
            self.session.run(requests(), handle)
        return total

    def _find_missing(self, bank: int, content: bytes) -> list[tuple[int, int]]:
        """Blocks (offset, bytes) of a bank that differ from `content`."""
        missing: list[tuple[int, int]] = []

        def handle(request: protocol.CrcRequest, reply: protocol.CrcReply) -> None:
            at, n = request.offset, request.length
            if zlib.crc32(content[at : at + n]) != reply.crc:
                missing.append((at, n))

        blocks = range(0, len(content), _BLOCK_BYTES)
        crcs = (protocol.CrcRequest(bank, at, min(_BLOCK_BYTES, len(content) - at)) for at in blocks)
        self.session.call_each(crcs, handle)
        return sorted(missing)

    def _wait_until_swapped(self) -> protocol.StatusReply:
        status = self.session.wait_for_status(lambda status: status.pending_bank == NO_BANK, 10.0, 0.002)
        if status.pending_bank != NO_BANK:
            raise VerifyError(
                f"{self.session.name}: bank {status.pending_bank} does not become active;"
                " the old one plays on; 'evlcp board stop', then program it again"
            )
        return status

    def wait_with_keep_alive(
        self, seconds: float, status: protocol.StatusReply, stopped: Stopped = never_stop
    ) -> None:
        """Wait, with requests often enough for the watchdog in the board's last status not to act."""
        line = self.session.transport
        end = line.time_s() + seconds
        acts = status.watchdog != Watchdog.KEEP
        pulse = status.watchdog_ms / 3e3 if acts else seconds
        while (left := end - line.time_s()) > 0.0 and not stopped():
            line.read(min(left, pulse, 1.0))  # not long, as it may be stopped
            if acts and line.time_s() < end:
                self.status()

    def wait_dark(self, timeout_s: float = 10.0) -> protocol.StatusReply:
        """Status when the LEDs are dark after a stop; errors as of `Session.wait_dark`."""
        return self.session.wait_dark(timeout_s)


def provision(
    board: Board, bank: Bank, settings: Settings, verify: bool = True, progress: Progress = lambda *_: None
) -> ProgramResult:
    """Set a board's bank and settings, as far as they differ.

    Limits and level are set first, so that a board that refuses them keeps its old bank. A duty limit below
    the old bank's duty is set after the new one; limits are restored if the new bank is refused.

    Raises:
        BoardError: See `Board.set_limits`, `Board.program` and `Board.set_level`.
        ConfigError: The bank does not fit the board.
    """
    if bank.rest is not None and settings.watchdog == "idle":
        raise ConfigError(
            "watchdog = idle: LEDs that are on for a chip of two say something in this link's framing;"
            " use dark, or keep"
        )
    bank = board.adapt_bank(bank)
    board.check_fits(bank)
    before = status = board.status()
    most_ma, duty = settings.level_limit_ma, settings.duty_limit
    duty_last = False
    if duty is not None:
        board.check_duty("this payload", bank.duty, duty)
        duty_last = before.active_bank != NO_BANK and before.duty > round(1000 * duty)
    if most_ma is not None or (duty is not None and not duty_last):
        board.set_limits(bank, most_ma, None if duty_last else duty)
        status = board.status()
    level = settings.level_ma
    level_last = level is not None and status.level_ma != level and not _try_level(board, level)
    if settings.watchdog is not None:
        wanted = (Watchdog[settings.watchdog.upper()], settings.watchdog_ms)
        if wanted != (status.watchdog, status.watchdog_ms):
            board.set_watchdog(*wanted)
    try:
        done = board.program(bank, verify, progress)
    except RefusedError:
        if (status.level_limit_ma, status.duty_limit) != (before.level_limit_ma, before.duty_limit):
            board.set_limits(bank, before.level_limit_ma, before.duty_limit / 1000)
            board.set_level(before.level_ma)
        raise
    if duty_last:
        board.set_limits(bank, None, duty)
    if level is not None and level_last:
        board.set_level(level)
    if settings.start and status.state != State.PLAYING:
        board.start()
    return done


def _try_level(board: Board, level_ma: int) -> bool:
    """Set the LED current; False if it is too high for the active bank, but perhaps not for the next one."""
    try:
        board.set_level(level_ma)
    except RefusedError as fault:
        if fault.status != Status.TOO_BRIGHT:
            raise
        return False
    return True


def profile_number(bank: Bank) -> int:
    """The protocol's number of a bank's codebook; `CUSTOM` for one that is not built into the firmware."""
    if not bank.composed:
        return Profile.CUSTOM
    return next((p for p, digest in DIGESTS.items() if digest == bank.digest), Profile.CUSTOM)
