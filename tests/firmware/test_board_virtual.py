"""Host and firmware together in virtual time: programming, swaps, noise, dying hosts, resets."""

import zlib

import numpy as np
import pytest
from board_lines import (
    PACKET,
    FatalLine,
    HostDiedError,
    NoisyLine,
    board_on,
    check_order,
    packet_sequence,
)

from evlcp_sdk.air.codebook import Codebook, hadamard
from evlcp_sdk.air.frames import PacketFormat, packet_chips
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import Bank, random_symbols, symbol_chips
from firmware_host.board.board import Board, Settings, profile_number, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import (
    BoardResetError,
    IncompatibleError,
    LineError,
    NoBoardError,
    RefusedError,
    VerifyError,
)
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import (
    MAJOR,
    MINOR,
    NO_BANK,
    BoardFault,
    CodebookRequest,
    CommitRequest,
    ConfigureRequest,
    CrcRequest,
    Format,
    LevelRequest,
    Profile,
    ReadRequest,
    State,
    StatusRequest,
    Watchdog,
    WriteReply,
    WriteRequest,
)


def codebook_of(profile: str) -> Codebook:
    return load_link(overrides=[f"modulation.id={profile}"]).codebook


pytestmark = pytest.mark.usefixtures("compiler")


def symbols_of(packets: int, seed: int, book: Codebook) -> np.ndarray:
    return random_symbols(packets, 10, book, np.random.default_rng(seed))


@pytest.fixture
def device() -> SimulatedBoard:
    return SimulatedBoard()


@pytest.fixture
def board(device: SimulatedBoard) -> Board:
    return board_on(SimulatedLine(device))


@pytest.mark.parametrize("profile", ["wh4x2", "wh8", "raw8"])
def test_plays_what_tx_frames_says(profile: str, device: SimulatedBoard, board: Board) -> None:
    book = codebook_of(profile)
    symbols = symbols_of(4, 0, book)
    provision(board, Bank.of_symbols(symbols, book), Settings())
    device.run(200_000)
    played = device.records().played()
    expected = symbol_chips(symbols, book)
    table = np.tile(expected, (3, 1))[: len(played)]
    assert len(played) > len(expected)
    assert (played.chips() == table).all()
    assert (np.diff(played.ticks) == device.TICK_HZ // 10_000).all()
    assert (played.numbers == np.arange(len(played))).all()


@pytest.mark.parametrize(("frames", "every"), [(10, 4), (20, 4), (7, 2), (3, 64)])
def test_plays_pilots_in_some_frames_only(
    frames: int, every: int, device: SimulatedBoard, board: Board, book: Codebook
) -> None:
    symbols = random_symbols(3, frames, book, np.random.default_rng(frames))
    provision(board, Bank.of_symbols(symbols, book, every), Settings())
    assert board.holds(Bank.of_symbols(symbols, book, every), board.status())
    assert not board.holds(Bank.of_symbols(symbols, book), board.status())
    device.run(400_000)
    chips = device.records().played().chips()
    expected = np.concatenate([packet_chips(packet, book, every) for packet in symbols])
    assert len(chips) > 2 * len(expected)
    assert (chips == np.resize(expected, chips.shape)).all()


def test_from_one_pilot_rate_to_another_without_a_torn_packet(
    device: SimulatedBoard, board: Board, book: Codebook
) -> None:
    symbols = random_symbols(2, 10, book, np.random.default_rng(0))
    full, sparse = (np.concatenate([packet_chips(p, book, n) for p in symbols]) for n in (1, 4))
    provision(board, Bank.of_symbols(symbols, book), Settings())
    device.run(100_000)
    provision(board, Bank.of_symbols(symbols, book, 4), Settings())
    device.run(100_000)
    chips = device.records().played().chips()
    half = len(full) // 2
    changes = [
        n
        for n in range(half, len(chips), half)
        if (chips[:n] == np.resize(full, (n, 16))).all()
        and (chips[n:] == np.resize(sparse, (len(chips) - n, 16))).all()
    ]
    assert len(changes) == 1


def test_masks_play_as_they_are(device: SimulatedBoard, board: Board, book: Codebook) -> None:
    random = np.random.default_rng(0)
    leds = random.integers(0, 2, (2 * PACKET, 96), dtype=np.uint8)
    provision(board, Bank.of_chips(leds, book, PacketFormat.of(book, 10, 20_000.0)), Settings())
    device.run(100_000)
    played = device.records().played()
    assert (played.chips(None)[: len(leds)] == leds).all()
    assert (np.diff(played.ticks) == device.TICK_HZ // 20_000).all()


@pytest.mark.parametrize("name", ["barker5", "wh8"])
def test_a_codebook_of_ones_own(name: str, device: SimulatedBoard, board: Board) -> None:
    rows = hadamard(8)
    book = Codebook.of_values(name, np.array([1, 1, 1, -1, 1], np.int8), np.concatenate([-rows, rows]), rows)
    symbols = random_symbols(2, 3, book, np.random.default_rng(0))
    bank = Bank.of_symbols(symbols, book)
    assert (bank.format, profile_number(bank)) == (Format.WORDS, Profile.CUSTOM)
    provision(board, bank, Settings())
    device.run(100_000)
    expected = symbol_chips(symbols, book)
    assert (device.records().played().chips()[: len(expected)] == expected).all()


def test_what_is_there_is_not_sent_again(device: SimulatedBoard, board: Board, book: Codebook) -> None:
    symbols = symbols_of(64, 0, book)
    payload = Bank.of_symbols(symbols, book)
    seen: list[tuple[int, int]] = []
    done = board.program(payload, progress=lambda a, b: seen.append((a, b)))
    assert (done.written, done.length, done.swapped, done.bank) == (20480, 20480, True, 0)
    assert seen[0] == (0, 20480)
    assert seen[-1] == (20480, 20480)
    assert [a for a, _ in seen] == sorted(a for a, _ in seen)
    again = board.program(payload)
    assert (again.written, again.swapped) == (0, False)
    assert board.program(Bank.of_symbols(symbols[:32], book)).bank == 1
    # bank 0 still holds the first payload: only the commit is needed
    back = board.program(payload)
    assert (back.written, back.swapped, back.bank) == (0, True, 0)
    changed = symbols.copy()
    changed[40, 3, 5] ^= 1
    board.program(Bank.of_symbols(symbols[:32], book))
    assert board.program(Bank.of_symbols(changed, book)).written == 2048


def test_hitless_swaps(device: SimulatedBoard, board: Board, book: Codebook) -> None:
    payloads = {}
    for n in range(12):
        name = f"p{n}"
        payloads[name] = symbols_of(1 + n % 4, 100 + n, book)
        provision(board, Bank.of_symbols(payloads[name], book), Settings())
        device.run(int(np.random.default_rng(n).integers(200_000, 500_000)))
    played = device.records().played()
    assert (np.diff(played.ticks) == 1000).all(), "a chip was lost or late"
    assert (played.numbers == np.arange(len(played))).all()
    sequence = packet_sequence(played, payloads, book)
    assert len(sequence) > 80
    order = check_order(sequence, {n: len(s) for n, s in payloads.items()})
    assert order == list(payloads)


def test_wrong_crc_or_codebook_never_plays(device: SimulatedBoard, board: Board, book: Codebook) -> None:
    old = symbols_of(2, 1, book)
    provision(board, Bank.of_symbols(old, book), Settings())
    payload = Bank.of_symbols(symbols_of(2, 2, book), book)
    board.prepare(payload)
    board.fill(1, payload.content)
    length, digest = len(payload.content), bytes.fromhex(book.digest)
    foreign = bytes.fromhex(codebook_of("wh8").digest)
    for commit, error in (
        (CommitRequest(1, 0, 2, length, payload.crc ^ 1, digest), VerifyError),
        (CommitRequest(1, 0, 2, length, payload.crc, foreign), IncompatibleError),
        (CommitRequest(1, 0, 2, length, payload.crc, bytes(32)), IncompatibleError),
        (CommitRequest(1, 0, 3, length, payload.crc, digest), RefusedError),
        (CommitRequest(1, 1, 2, length, payload.crc, digest), RefusedError),
        (CommitRequest(2, 0, 2, length, payload.crc, digest), RefusedError),
    ):
        with pytest.raises(error):
            board.session.call(commit)
        device.run(100_000)
        status = board.status()
        assert (status.active_bank, status.pending_bank, status.commits) == (0, NO_BANK, 1)
    pilots = tuple(range(16))
    with pytest.raises(IncompatibleError, match="built with another codebook"):
        board.session.call(CodebookRequest(26, 0, pilots, digest))
    board.session.call(ConfigureRequest(10_000, Profile.WH8, 10, 1, 0, 0))
    with pytest.raises(IncompatibleError):
        board.session.call(CommitRequest(1, 0, 2, length, payload.crc, digest))
    device.run(500_000)
    sequence = packet_sequence(device.records().played(), {"old": old}, book)
    assert len(sequence) > 20


def test_a_thousand_requests_over_a_noisy_line(device: SimulatedBoard) -> None:
    # An answer of STATUS is spoilt one time in ten: five tries on end are, in one of a hundred thousand.
    line = NoisyLine(device, flips=3e-4, drops=0.003, doubles=0.006, seed=7)
    board = board_on(line)
    random = np.random.default_rng(4)
    bank = bytearray(board.read(1, 0, 4096))
    level, session, retried = board.status().level_ma, board.session, 0
    for _ in range(1_000):
        what = random.integers(5)
        at = int(random.integers(4000))
        n = int(random.integers(1, 64))
        if what == 0:
            data = random.bytes(n)
            assert session.call(WriteRequest(1, at, data)) == WriteReply(1, at, n)
            bank[at : at + n] = data
        elif what == 1:
            assert session.call(ReadRequest(1, at, n)).data == bank[at : at + n]
        elif what == 2:
            expected = zlib.crc32(bytes(bank[at : at + n]))
            assert session.call(CrcRequest(1, at, n)).crc == expected
        elif what == 3:
            level = int(random.integers(61))
            session.call(LevelRequest(level))
        else:
            assert session.call(StatusRequest()).level_ma == level
    retried = session.client.retries
    status = board.status()
    assert board.read(1, 0, 4096) == bytes(bank)
    assert retried > 30
    assert status.crc_errors + status.framing_errors > 5
    assert line.counts["flipped"] > 10
    assert min(line.counts.values()) > 4


def test_programming_over_a_very_noisy_line(device: SimulatedBoard, book: Codebook) -> None:
    board = board_on(NoisyLine(device, flips=2e-3, drops=0.01, doubles=0.01, seed=5))
    symbols = symbols_of(64, 6, book)
    payload = Bank.of_symbols(symbols, book)
    done = provision(board, payload, Settings())
    assert done.retries > 20
    device.run(3_000_000)
    assert board.crc(0, 0, len(payload.content)) == payload.crc
    sequence = packet_sequence(device.records().played(), {"new": symbols}, book)
    assert check_order(sequence, {"new": 64}) == ["new"]
    assert len(sequence) > 64


def _bytes_of_programming(old: np.ndarray, new: np.ndarray, book: Codebook) -> int:
    device = SimulatedBoard()
    provision(board_on(SimulatedLine(device)), Bank.of_symbols(old, book), Settings())
    device.run(50_000)
    line = FatalLine(device, 1 << 30, lambda: None)
    provision(board_on(line, nonce=7), Bank.of_symbols(new, book), Settings())
    return line.written


def test_host_killed_at_any_moment(book: Codebook) -> None:
    old, new = symbols_of(2, 1, book), symbols_of(24, 2, book)
    total = _bytes_of_programming(old, new, book)
    random = np.random.default_rng(7)
    # the commit and the wait for it are the last bytes: half of the moments lie there
    moments = [*random.integers(1, total, 12), *random.integers(total - 320, total, 12)]
    ends = {"old": 0, "new": 0}

    def die() -> None:
        raise HostDiedError

    for moment in moments:
        device = SimulatedBoard()
        provision(board_on(SimulatedLine(device)), Bank.of_symbols(old, book), Settings())
        device.run(50_000)
        with pytest.raises(HostDiedError):
            provision(
                board_on(FatalLine(device, int(moment), die), nonce=7),
                Bank.of_symbols(new, book),
                Settings(),
            )
        device.run(400_000)
        sequence = packet_sequence(device.records().played(), {"old": old, "new": new}, book)
        order = check_order(sequence, {"old": 2, "new": 24})
        assert order in (["old"], ["old", "new"])
        ends[order[-1]] += 1
        # the next host finishes the work
        board = board_on(SimulatedLine(device))
        done = provision(board, Bank.of_symbols(new, book), Settings())
        assert board.holds(Bank.of_symbols(new, book), board.status())
        assert done.swapped == (order[-1] == "old")
    assert min(ends.values()) > 1


def _fault_of(line: SimulatedLine, payload: Bank) -> str | None:
    try:
        provision(board_on(line, nonce=7), payload, Settings())
    except BoardResetError as fault:
        return str(fault)
    return None


def test_board_reset_at_any_moment(book: Codebook) -> None:
    payload = Bank.of_symbols(symbols_of(12, 2, book), book)
    total = _bytes_of_programming(symbols_of(2, 1, book), symbols_of(12, 2, book), book)
    random = np.random.default_rng(8)
    told = 0
    for moment in random.integers(1, total, 20):
        device = SimulatedBoard()
        first = Bank.of_symbols(symbols_of(2, 1, book), book)
        provision(board_on(SimulatedLine(device)), first, Settings())
        device.run(50_000)
        fault = _fault_of(FatalLine(device, int(moment), device.reset), payload)
        if fault is not None:
            told += 1
            assert "was reset" in fault
            assert "run the command again" in fault
        board = board_on(SimulatedLine(device))
        if board.status().state == State.PLAYING:
            assert board.holds(payload, board.status())
        provision(board, payload, Settings())
        assert board.holds(payload, board.status())
        assert board.status().state == State.PLAYING
    # a reset before HELLO arrives, or after the last request, goes unnoticed by right
    assert told > 14


def test_silence_is_told(device: SimulatedBoard, board: Board) -> None:
    class Deaf(SimulatedLine):
        def to_board(self, data: bytes) -> bytes:
            del data
            return b""

    with pytest.raises(NoBoardError, match="no board answers; check power, cable and --baud"):
        board_on(Deaf(device))
    board.session.transport = Deaf(device)
    with pytest.raises(LineError, match="no answer to STATUS after 5 tries"):
        board.status()
    assert NoBoardError.exit_code == 4
    assert LineError.exit_code == 6


@pytest.mark.parametrize(("major", "older"), [(MAJOR - 1, "host"), (MAJOR + 1, "firmware")])
def test_another_major_version_is_incompatible(
    device: SimulatedBoard, monkeypatch: pytest.MonkeyPatch, major: int, older: str
) -> None:
    monkeypatch.setattr("firmware_host.board.session.MAJOR", major)
    words = rf"it speaks protocol {MAJOR}\.{MINOR}, this host .*; update the {older}"
    with pytest.raises(IncompatibleError, match=words):
        Board(Session(SimulatedLine(device), Timing()))


def test_what_a_watchdog_did_is_told_to_the_host_that_comes_back(
    device: SimulatedBoard, board: Board, book: Codebook
) -> None:
    provision(board, Bank.of_symbols(symbols_of(2, 0, book), book), Settings())
    board.watchdog(Watchdog.DARK, 200)
    device.run(1_000_000)
    again = board_on(SimulatedLine(device))
    for _ in range(2):
        status = again.status()
        assert (status.state, status.faults) == (State.DARK, BoardFault.WATCHDOG)
    assert Board(Session(SimulatedLine(device), Timing())).status().faults == BoardFault.WATCHDOG
    again = board_on(SimulatedLine(device))
    again.start()
    assert again.status().faults == 0


def test_too_much_is_told_before_anything_is_sent(board: Board, book: Codebook) -> None:
    payload = Bank.of_symbols(symbols_of(129, 0, book), book)
    with pytest.raises(ConfigError, match="send at most 128 packets"):
        board.program(payload)
    assert board.status().requests <= 3
    # 2 bytes for each of 16 clusters a frame: 1280 frames fill the 40960 bytes
    one = Bank.of_symbols(random_symbols(1, 1281, book, np.random.default_rng(0)), book)
    with pytest.raises(ConfigError, match=r"1281 frames takes 40992 bytes.*at most 1280 frames"):
        board.program(one)
    # 12 bytes per chip: 3413 chips, 26 of the preamble and 32 a frame
    masks = Bank.of_chips(np.zeros((26 + 32 * 106, 96), np.uint8), book, PacketFormat.of(book, 106))
    with pytest.raises(ConfigError, match="at most 105 frames"):
        board.program(masks)


def test_a_chip_rate_that_cannot_be_is_told_with_the_nearest(board: Board, book: Codebook) -> None:
    symbols = symbols_of(1, 0, book)
    for rate in (7777, 20_001, 1_000_000):
        nearest = min((r for r in range(1, 20_001) if 10_000_000 % r == 0), key=lambda r: abs(r - rate))
        with pytest.raises(
            RefusedError, match=f"no chip rate of {rate} Hz.* nearest .* is {nearest}$"
        ) as told:
            board.program(Bank.of_symbols(symbols, book, chip_rate_hz=rate))
        assert told.value.detail == nearest
        slower = Bank.of_symbols(symbols, book, chip_rate_hz=nearest)
        assert board.program(slower).swapped or rate > 20_001


def test_level_above_the_maximum_is_refused(board: Board, book: Codebook) -> None:
    with pytest.raises(RefusedError, match="nearest value the board can take is 60") as refused:
        provision(board, Bank.of_symbols(symbols_of(1, 0, book), book), Settings(level_ma=61))
    assert refused.value.detail == 60
    assert refused.value.exit_code == 5
    status = board.status()
    assert (status.level_ma, status.active_bank) == (20, NO_BANK)


def test_save_survives_reset_and_damage(device: SimulatedBoard, book: Codebook) -> None:
    first, second = symbols_of(1, 1, book), symbols_of(2, 2, book)
    board = board_on(SimulatedLine(device))
    settings = Settings(level_ma=33, watchdog=Watchdog.IDLE, watchdog_ms=700, start=False)
    for symbols in (first, second):
        provision(board, Bank.of_symbols(symbols, book), settings)
        board.save()
    device.reset()
    board = board_on(SimulatedLine(device))
    assert board.recall().slot == 1
    status = board.status()
    assert board.holds(Bank.of_symbols(second, book), status)
    assert (status.level_ma, status.watchdog, status.watchdog_ms) == (33, Watchdog.IDLE, 700)
    held = bytearray(device.flash())
    held[len(held) // 2 + 200] ^= 0x10
    device.set_flash(bytes(held))
    device.reset()
    board = board_on(SimulatedLine(device))
    assert board.recall().slot == 0
    assert board.holds(Bank.of_symbols(first, book), board.status())
    board.save(autostart=True)
    device.reset()
    device.records()
    device.run(100_000)
    assert packet_sequence(device.records().played(), {"first": first}, book)
    device.set_failures(flash=True)
    board = board_on(SimulatedLine(device))
    board.blank()
    with pytest.raises(RefusedError, match="flash"):
        board.save()


def test_faults_show_and_darken(device: SimulatedBoard, board: Board, book: Codebook) -> None:
    provision(board, Bank.of_symbols(symbols_of(1, 0, book), book), Settings())
    device.set_health(30.0, BoardFault.OPEN_LED, open_led=95)
    device.run(300_000)
    status = board.status()
    assert (status.temperature_dc, status.faults, status.open_leds[-1]) == (300, BoardFault.OPEN_LED, 1)
    device.set_health(120.0, BoardFault.OVER_TEMPERATURE)
    device.run(300_000)
    assert board.status().state == State.FAULT
    assert not device.shown().any()
    with pytest.raises(RefusedError, match="a fault holds the LEDs dark"):
        board.start()
    device.set_health()
    board.start()
    device.run(10_000)
    assert board.status().state == State.PLAYING
    device.set_late(1000)
    device.run(1000)
    status = board.status()
    assert status.state == State.FAULT
    assert status.faults & BoardFault.CHIP_LOST
    assert not device.shown().any()


def test_a_fault_that_comes_back_ends_the_led_test(device: SimulatedBoard, board: Board) -> None:
    device.set_health(120.0, BoardFault.OVER_TEMPERATURE)
    device.run(300_000)
    device.set_health()
    device.run(300_000)
    board.test_leds(0, 95, 1000)
    assert device.shown().any()
    device.set_health(120.0, BoardFault.OVER_TEMPERATURE)
    device.run(300_000)
    assert not device.shown().any()


def test_a_packet_may_take_longer_than_ten_seconds(
    device: SimulatedBoard, board: Board, book: Codebook
) -> None:
    # 400 frames at 1000 chips/s: 12.8 s
    old, new = (
        Bank.of_symbols(random_symbols(1, 400, book, np.random.default_rng(n)), book, chip_rate_hz=1000)
        for n in (0, 1)
    )
    provision(board, old, Settings())
    device.run(10_000)
    assert provision(board, new, Settings()).swapped
    board.stop()
    assert board.wait_dark().state == State.DARK
