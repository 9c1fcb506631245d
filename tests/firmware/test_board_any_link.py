"""Any link on a board: other bars, other codes, chips as they are; virtual, in QEMU, on the model."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from board_lines import board_on
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat, packet_chips
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from firmware_host import build
from firmware_host.board.bank import Bank, bank_of, random_symbols, symbol_chips
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import IncompatibleError, RefusedError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import (
    BoardFault,
    ChipsRequest,
    CommitRequest,
    Format,
    State,
    Status,
    StreamRequest,
    Watchdog,
)

pytestmark = pytest.mark.usefixtures("compiler")

SIZES = (3, 14, 1, 9, 9, 20, 6, 2, 12, 11)
LED_CLUSTERS = np.random.default_rng(4).permutation(np.repeat(np.arange(10), SIZES))
"""87 LEDs in ten clusters of other sizes, side by side in no order: the cluster of each LED."""


def book_of(clusters: int, values: int) -> Codebook:
    """Codes of `2 * values` chips, drawn at random."""
    rng = np.random.default_rng(values)
    codes = np.unique(rng.choice(np.array([-1, 1], np.int8), (4 * clusters + 64, values)), axis=0)
    codes = rng.permutation(codes)
    preamble = rng.choice(np.array([-1, 1], np.int8), 40)
    return Codebook.of_values("drawn", preamble, codes[:clusters], codes[clusters : clusters + 16])


BOOK = book_of(10, 12)
SYMBOLS = random_symbols(2, 3, BOOK, np.random.default_rng(1))


def a_bank(**changes: float) -> Bank:
    return Bank.of_symbols(SYMBOLS, BOOK, 2, led_clusters=LED_CLUSTERS, **changes)


def leds_of(chips: NDArray[np.uint8], led_clusters: NDArray[np.int64]) -> NDArray[np.uint8]:
    """What the 96 outputs do for chips of clusters, uint8 (chips, 96); without the code that is tested."""
    found = np.zeros((len(chips), 96), np.uint8)
    for led, cluster in enumerate(led_clusters):
        found[:, led] = chips[:, cluster]
    return found


EXPECTED = leds_of(symbol_chips(SYMBOLS, BOOK, 2), LED_CLUSTERS)
"""80 chips of preamble, two pilots and three words of 24: twice."""


def shown(device: SimulatedBoard) -> NDArray[np.uint8]:
    return device.records().played().chips(None)


@pytest.fixture
def device() -> SimulatedBoard:
    return SimulatedBoard()


@pytest.fixture
def board(device: SimulatedBoard) -> Board:
    return board_on(SimulatedLine(device))


def test_other_clusters_and_codes_of_24_chips_on_every_led(device: SimulatedBoard, board: Board) -> None:
    bank = a_bank()
    assert EXPECTED.shape == (400, 96)
    # ten clusters are two bytes a chip, behind the 12 bytes of each cluster's mask
    assert (bank.format, len(bank.content)) == (Format.CLUSTERS, 10 * 12 + 400 * 2)
    done = provision(board, bank, Settings())
    assert (done.written, done.swapped) == (len(bank.content), True)
    device.run(150_000)
    board.stop()
    board.wait_dark()
    rows = shown(device)
    assert len(rows) > 1200
    assert len(rows) % 200 == 0, "whole packets"
    assert (rows == np.resize(EXPECTED, rows.shape)).all()
    status = board.status()
    assert (status.packet_chips, status.clusters, status.hold, status.faults) == (200, 10, 1, 0)
    assert status.duty == bank.duty == np.ceil(1000 * EXPECTED.mean(0).max() - 1e-9)
    assert board.verify(bank) == status.active_bank
    assert provision(board, bank, Settings()).written == 0
    # and back to words, which are sent as they always were
    link = load_link()
    words = bank_of(random_symbols(1, 10, link.codebook, np.random.default_rng(0)), link)
    assert words.format == Format.WORDS
    provision(board, words, Settings())
    device.run(100_000)
    assert board.status().hold == 0
    assert board.verify(words) != status.active_bank


def test_the_image_on_the_model_of_the_part(needs: Callable[..., None]) -> None:
    needs("cc", "make", "arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models.stm32 import US, Dma, ModelLine, Stm32

    chip = Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    assert board.about.chip_rate_min_hz == 1282  # chips of 0.78 ms
    provision(board, a_bank(), Settings())
    begin = len(chip.drivers.log)
    chip.run(12_000)
    rows = [s.row for s in chip.drivers.log[begin:] if s.latched and not s.dark]
    leds = np.array([[int(bit) for bit in f"{row:096b}"] for row in rows], np.uint8)
    lit = int(leds.any(1).argmax())
    first = int(EXPECTED.any(1).argmax())
    wanted = np.resize(np.roll(EXPECTED, -first, axis=0), (100, 96))
    assert (leds[lit : lit + 100] == wanted).all()
    assert chip.longest[16 + Dma.IRQ] < 12 * US
    chip.dma.dead = True
    chip.run(300)
    assert chip.drivers.dark
    assert board.status().faults == BoardFault.CHIP_LOST


@given(st.data())
@settings(max_examples=25, deadline=None)
def test_any_clusters_of_any_leds(data: st.DataObject) -> None:
    """Clusters of any number and order, chips of any kind and length: every LED against NumPy."""
    device = SimulatedBoard()
    board = board_on(SimulatedLine(device))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    clusters = data.draw(st.sampled_from([1, 2, 7, 8, 9, 15, 16, 17, 31, 33, 64, 88, 89, 96]))
    leds = data.draw(st.integers(clusters, 96))
    which = np.concatenate([np.arange(clusters), rng.integers(0, clusters, leds - clusters)])
    which = rng.permutation(which)
    packet = replace(PacketFormat.of(book_of(clusters, 8), 1), preamble_chips=data.draw(st.integers(1, 40)))
    packets = data.draw(st.integers(1, 5))
    chips = rng.integers(0, 2, (packets * packet.packet_chips, clusters), dtype=np.uint8)
    bank = Bank.of_chips(chips, book_of(clusters, 8), packet, which)
    assert bank.format == (Format.CLUSTERS if clusters <= 88 else Format.MASKS)
    provision(board, bank, Settings())
    device.run(data.draw(st.integers(1, 400)) * 100)
    assert board.verify(bank) == 0
    rows = shown(device)
    assert (rows == np.resize(leds_of(chips, which), rows.shape)).all()
    assert board.status().duty == bank.duty == np.ceil(1000 * chips.mean(0).max() - 1e-9)


def test_every_led_for_itself(device: SimulatedBoard, board: Board) -> None:
    rows = np.random.default_rng(2).integers(0, 2, (400, 87), dtype=np.uint8)
    bank = Bank.of_chips(rows, BOOK, PacketFormat.of(BOOK, 3, pilot_every=2), LED_CLUSTERS)
    assert (bank.format, bank.packets, len(bank.content)) == (Format.MASKS, 2, 400 * 12)
    provision(board, bank, Settings())
    device.run(100_000)
    seen = shown(device)
    assert (seen[:400, :87] == rows).all()
    assert not seen[:, 87:].any()


@pytest.mark.parametrize(
    ("overrides", "form"),
    [
        (["modulation.id=nrz"], None),
        (["modulation.id=ppm"], None),
        (["modulation.id=wh4x2-dimmed", "pilots.id=wh-dimmed"], None),
        (["bar.rows=1", "bar.cluster_rows=1", "ranging.id=none", "modulation.id=nrz"], Format.CLUSTERS),
    ],
    ids=["nrz", "ppm", "dimmed", "one LED"],
)
def test_the_codes_that_are_installed(
    device: SimulatedBoard, board: Board, overrides: list[str], form: Format | None
) -> None:
    link = load_link(overrides=["separation.id=edges", "decoding.id=edges", *overrides])
    symbols = random_symbols(2, link.packet.frames, link.codebook, np.random.default_rng(1))
    bank = bank_of(symbols, link)
    assert form in (None, bank.format)
    chips = leds_of(
        np.concatenate([packet_chips(one, link.codebook, link.packet.pilot_every) for one in symbols]),
        link.bar.led_clusters(),
    )
    share = np.ceil(1000 * chips.mean(0).max() - 1e-9) / 1000
    provision(board, bank, Settings(duty_limit=share))
    device.run(200_000)
    rows = shown(device)
    assert len(rows) >= 1900
    assert (rows == np.resize(chips, rows.shape)).all()
    # a stream, whose idle pattern is no brighter, keeps to the same limit
    with board.stream(link) as stream:
        stream.wait(0.1)
        for packet in symbols:
            stream.send(packet)
    rows = shown(device)
    assert (rows[-len(chips) :] == chips).all()
    assert board.status().faults == 0


def test_packets_that_come_one_by_one(device: SimulatedBoard, board: Board) -> None:
    link = load_link(overrides=["bar.rows=90", "bar.cluster_rows=9", "pilots.id=barker13"])
    packets = random_symbols(8, link.packet.frames, link.codebook, np.random.default_rng(0))
    with board.stream(link, 4) as stream:
        for packet in packets:
            stream.send(packet)
        stream.wait(1.0)
        for packet in packets[:2]:
            stream.send(packet)
        with pytest.raises(ConfigError, match=r"shape \(9, 10\), expected \(10, 10\)"):
            stream.send(packets[0][:9])
    rows = shown(device)
    # the idle pattern is of the bar's LEDs alone, and stands between packets
    assert not rows[:, 90:].any()
    chips = rows[:, :90:9]
    assert (rows[:, :90] == np.repeat(chips, 9, axis=1)).all()
    length = link.packet.packet_chips
    told = symbol_chips(np.concatenate([packets, packets[:2]]), link.codebook, link.packet.pilot_every)
    start = next(n for n in range(0, 1000, 2) if (chips[n : n + 8 * length] == told[: 8 * length]).all())
    assert (chips[-2 * length :] == told[-2 * length :]).all()
    between = chips[start + 8 * length : -2 * length]
    assert (between == np.arange(len(between))[:, None] % 2).all()
    assert stream.underruns == 1
    assert not device.shown().any()


def test_a_packet_longer_than_half_a_bank_is_no_stream(board: Board) -> None:
    link = load_link(overrides=["bar.rows=90", "bar.cluster_rows=9", "air.frames_per_packet=700"])
    with pytest.raises(ConfigError, match=r"a packet of 22426 chips takes 44852 bytes.*room for two.*10210"):
        board.stream(link)
    with pytest.raises(ConfigError, match=r"has 40960, 120 of them for the clusters: not one fits.*20420"):
        board.program(bank_of(random_symbols(1, 700, link.codebook, np.random.default_rng(0)), link))


def test_a_bank_is_full_to_the_last_byte(device: SimulatedBoard, board: Board) -> None:
    """Ten clusters: 12 bytes each, then two bytes a chip; 20 420 chips fill 40 960 bytes, 2 s of light."""
    chips = np.random.default_rng(5).integers(0, 2, (20_420, 10), dtype=np.uint8)
    packet = replace(PacketFormat.of(BOOK, 1), preamble_chips=len(chips) - 48)
    bank = Bank.of_chips(chips, BOOK, packet, LED_CLUSTERS)
    assert len(bank.content) == board.about.bank_bytes == 40_960
    provision(board, bank, Settings())
    device.run(2_050_000)
    rows = shown(device)
    expected = leds_of(chips, LED_CLUSTERS)
    assert len(rows) > len(expected)
    assert (rows == np.resize(expected, rows.shape)).all()
    more = replace(packet, preamble_chips=packet.preamble_chips + 1)
    with pytest.raises(
        ConfigError, match=r"20421 chips takes 40842 bytes.*not one fits.*at most 20420 chips"
    ):
        board.program(Bank.of_chips(np.zeros((20_421, 10), np.uint8), BOOK, more, LED_CLUSTERS))


def test_from_words_to_chips_and_back_without_a_dark_chip(device: SimulatedBoard, board: Board) -> None:
    link = load_link()
    symbols = random_symbols(2, 10, link.codebook, np.random.default_rng(0))
    words = np.repeat(symbol_chips(symbols, link.codebook), 6, axis=1)
    known = {
        rows.tobytes(): name for name, both in (("w", words), ("c", EXPECTED)) for rows in np.split(both, 2)
    }
    provision(board, bank_of(symbols, link), Settings())
    for bank in 3 * [a_bank(), bank_of(symbols, link)]:
        board.program(bank)
        device.run(60_000)
    record = device.records().played()
    assert (np.diff(record.ticks) == 1000).all()
    rows, at, names = record.chips(None), 0, ""
    while at + 346 <= len(rows):
        name = next(known[part] for n in (200, 346) if (part := rows[at : at + n].tobytes()) in known)
        names += name if not names.endswith(name) else ""
        at += 346 if name == "w" else 200
    assert names.startswith("wcwcwcw")


def test_it_is_kept_over_a_reset(device: SimulatedBoard, board: Board) -> None:
    bank = a_bank(chip_rate_hz=5000)
    provision(board, bank, Settings(level_ma=7, start=False))
    board.save(autostart=True)
    device.reset()
    device.records()
    device.run(200_000)
    rows = shown(device)
    assert len(rows) > 900
    assert (rows == np.resize(EXPECTED, rows.shape)).all()
    again = board_on(SimulatedLine(device), nonce=9)
    assert again.holds(bank, again.status())
    assert not again.program(bank).written


def test_limits_of_light_hold_for_clusters(device: SimulatedBoard, board: Board) -> None:
    """The share of the brightest cluster is refused before, and a burst ends in the dark."""
    packet = replace(PacketFormat.of(BOOK, 1), preamble_chips=952)  # 1000 chips in all
    chips = np.zeros((1000, 10), np.uint8)
    chips[100:400, 3] = 1
    bank = Bank.of_chips(chips, BOOK, packet, LED_CLUSTERS)
    with pytest.raises(RefusedError, match=r"for 0\.3 of the time, the duty limit is 0\.299"):
        provision(board, bank, Settings(duty_limit=0.299))
    board.limit(bank, duty=0.299)
    with pytest.raises(RefusedError) as told:
        board.program(bank)
    assert (told.value.status, told.value.detail) == (Status.TOO_BRIGHT, 299)
    provision(board, bank, Settings(duty_limit=0.3))
    device.run(200_000)
    burst = board.about.burst_chips
    rows = shown(device)
    # on for n chips in a row is 0.7 n beyond its share
    assert len(rows) == 100 + int(burst / 0.7)
    assert (rows == leds_of(chips, LED_CLUSTERS)[: len(rows)]).all()
    assert not device.shown().any()
    assert board.status().faults == BoardFault.OVER_LIMIT


def test_silence_shows_the_idle_pattern_of_the_bars_leds(device: SimulatedBoard, board: Board) -> None:
    provision(board, a_bank(), Settings(watchdog=Watchdog.IDLE, watchdog_ms=100))
    device.run(200_000)
    idle = shown(device)[-200:]
    assert (idle[:, :87] != np.roll(idle[:, :87], 1, axis=0))[1:].all()
    assert not idle[:, 87:].any()


@pytest.mark.parametrize(("limit", "every"), [(1.0, 2), (0.5, 2), (0.3, 4), (0.25, 4), (0.001, 1000)])
def test_the_idle_pattern_keeps_to_the_limits(
    device: SimulatedBoard, board: Board, limit: float, every: int
) -> None:
    """LEDs are on for no more of it than they may be, whatever the length of a packet."""
    packet = replace(PacketFormat.of(BOOK, 1), preamble_chips=103)
    bank = Bank.of_chips(np.zeros((151, 10), np.uint8), BOOK, packet, LED_CLUSTERS)
    settings_ = Settings(watchdog=Watchdog.IDLE, watchdog_ms=100, duty_limit=limit)
    provision(board, bank, settings_)
    device.run(700_000)
    on = np.flatnonzero(shown(device)[:, 0])
    assert (np.diff(on) == every).all()
    assert len(on) >= 5
    assert on[0] % 151 == every - 1 if every < 151 else True
    assert board.status().faults == BoardFault.WATCHDOG


def chips_request(**changes: object) -> ChipsRequest:
    return replace(ChipsRequest(200, 1, 10, bytes.fromhex(BOOK.digest)), **changes)  # type: ignore[arg-type]


def test_what_the_firmware_refuses(device: SimulatedBoard, board: Board) -> None:
    for wrong, nearest in (
        ({"packet_chips": 0}, 1),
        ({"packet_chips": 40961}, 40960),
        ({"packet_chips": 2**32 - 1}, 40960),
        ({"hold": 0}, 1),
        ({"clusters": 97}, 96),
    ):
        with pytest.raises(RefusedError) as told:
            board.session.call(chips_request(**wrong))
        assert (told.value.status, told.value.detail) == (Status.OUT_OF_RANGE, nearest)
    bank = a_bank()
    commit = CommitRequest(0, bank.format, 2, len(bank.content), bank.crc, bytes.fromhex(bank.digest))
    with pytest.raises(RefusedError):
        board.session.call(commit)  # CLUSTERS with a codebook
    board.prepare(bank)
    board.fill(0, bank.content)
    for other in (
        replace(commit, format=Format.WORDS),
        replace(commit, format=3),
        replace(commit, packets=0),
        replace(commit, packets=3),
        replace(commit, packets=65535),
        replace(commit, length=len(bank.content) - 2),
        replace(commit, format=Format.MASKS),
        replace(commit, digest=bytes(32)),
    ):
        with pytest.raises((RefusedError, IncompatibleError)):
            board.session.call(other)
    # an LED of two clusters would be on for longer than either
    overlapping = bytearray(bank.content)
    overlapping[12] |= overlapping[0]
    overlapping[13] |= overlapping[1]
    twice = replace(bank, content=bytes(overlapping))
    board.fill(0, twice.content)
    with pytest.raises(RefusedError) as told:
        board.session.call(replace(commit, crc=twice.crc))
    assert (told.value.status, told.value.detail) == (Status.OUT_OF_RANGE, 1)
    with pytest.raises(RefusedError):
        board.session.call(StreamRequest(0, Format.CLUSTERS, commit.digest))
    board.prepare(bank)
    device.run(10_000)
    assert not device.shown().any()
    # bits beyond the last cluster light nothing
    padded = bytearray(bank.content)
    for at in range(121, len(padded), 2):
        padded[at] |= 0x3F
    board.fill(0, bytes(padded))
    crc = replace(bank, content=bytes(padded)).crc
    board.session.call(replace(commit, crc=crc))
    board.start()
    device.run(50_000)
    rows = shown(device)
    assert (rows == np.resize(EXPECTED, rows.shape)).all()


def test_what_hello_says_decides(board: Board) -> None:
    def says(**changes: int) -> None:
        for name, value in changes.items():
            object.__setattr__(board.about, name, value)

    requests = board.status().requests
    panel = load_link(
        overrides=["bar.rows=16", "bar.columns=16", "bar.cluster_rows=4", "bar.cluster_columns=4"]
    )
    symbols = random_symbols(1, 10, panel.codebook, np.random.default_rng(0))
    with pytest.raises(ConfigError, match=r"a link of 256 LEDs, simulated: has 96: HELLO says so"):
        board.program(bank_of(symbols, panel))
    with pytest.raises(ConfigError, match=r"a link of 256 LEDs"):
        board.stream(panel)
    says(leds=48, clusters=8)
    with pytest.raises(ConfigError, match=r"a link of 87 LEDs, simulated: has 48"):
        board.program(a_bank())
    # a firmware of before says nothing of formats
    says(leds=96, clusters=16, formats=0, minor=1)
    with pytest.raises(IncompatibleError) as told:
        board.program(a_bank())
    assert str(told.value) == (
        "simulated:: its firmware (protocol 2.1) plays packets that it composes alone, and this link has"
        " 87 LEDs in 10 clusters, not 96 in 16 equal ones; pilots: codes of 24 chips, not 16; modulation:"
        " codes of 24 chips, not 16; preamble of 80 chips, more than 32; update the firmware"
    )
    assert board.status().requests == requests + 1


def test_a_rate_that_cannot_be(board: Board) -> None:
    with pytest.raises(RefusedError, match=r"no chip rate of 7777 Hz: must divide 10000000 Hz, at least 1,"):
        board.program(a_bank(chip_rate_hz=7777))
    with pytest.raises(ConfigError, match=r"air.chip_rate_hz = 12.5: a board takes whole"):
        a_bank(chip_rate_hz=12.5)


def test_chips_that_the_board_has_none_as_long_as(device: SimulatedBoard, board: Board) -> None:
    object.__setattr__(board.about, "chip_rate_min_hz", 1282)
    bank = a_bank(chip_rate_hz=500)
    provision(board, bank, Settings())
    status = board.status()
    assert (status.chip_rate_hz, status.hold, status.packet_chips) == (2000, 4, 800)
    device.run(1_300_000)
    rows = shown(device)
    assert (rows == np.resize(np.repeat(EXPECTED, 4, axis=0), rows.shape)).all()
    assert status.state == State.PLAYING
    assert board.holds(bank, status)
    board.check_same_air(bank, status)
    assert board.verify(bank) == 0
    with board.stream(load_link(overrides=["bar.rows=60", "bar.columns=1", "air.chip_rate_hz=500.0"])) as s:
        assert s.packet_s == pytest.approx(346 / 500)


ANY = ("bar.rows=90", "bar.cluster_rows=9", "pilots.id=barker13")
OPTIONS = [part for setting in ANY for part in ("--set", setting)]


def test_the_commands(evlcp, tmp_path: Path) -> None:
    device = SimulatedBoard()
    link = load_link(overrides=list(ANY))
    symbols = random_symbols(2, 10, link.codebook, np.random.default_rng(3))
    provision(board_on(SimulatedLine(device)), bank_of(symbols, link), Settings())
    device.run(200_000)
    record, out = tmp_path / "leds.bin", tmp_path / "chips.npy"
    record.write_bytes(device.records().to_bytes())
    assert evlcp("board", "leds", record, "--chips", out, *OPTIONS).code == 0
    chips = np.load(out)
    assert (chips == np.resize(symbol_chips(symbols, link.codebook), chips.shape)).all()
    # those chips are what a board is sent for the same link, column by column
    whole = symbol_chips(symbols, link.codebook)
    np.save(out, whole)
    for options in (("--masks", out), ("--random", 2, "--seed", 3)):
        done = evlcp("board", "--port", "native:", "program", *options, *OPTIONS)
        assert (done.code, done.err) == (0, ""), done.err
        assert f"of {10 * 12 + 2 * len(whole)} bytes" in done.out
    for rows, cluster_rows, says in (
        (80, 8, "LED 80 is lit, the link's bar has 80"),
        (90, 6, "the LEDs of cluster 4 differ; take every LED for itself with --per-led"),
    ):
        other = ("--set", f"bar.rows={rows}", "--set", f"bar.cluster_rows={cluster_rows}")
        done = evlcp("board", "leds", record, "--chips", out, *OPTIONS[4:], *other)
        assert (done.code, done.err.count("\n")) == (3, 1)
        assert says in done.err


def test_a_fleet_of_several_links(evlcp, tmp_path: Path) -> None:
    head = "[[board]]\nport = 'native:'\nposition_m = [0, 0, 0]\nrandom = 2\n"
    links = {
        "a": "{}",
        "b": "{bar = {rows = 90, cluster_rows = 9}, pilots = {id = 'barker13'}}",
        "c": "{bar = {rows = 16, columns = 16, cluster_rows = 4, cluster_columns = 4}}",
        "d": "{bar = {rows = 24, cluster_rows = 3}}",
    }
    file = tmp_path / "tunnel.toml"
    file.write_text("".join(f"{head}id = '{name}'\nlink = {link}\n" for name, link in links.items()))
    done = evlcp("board", "program", "--inventory", file)
    lines = dict(line.split("  ", 1) for line in sorted(done.out.splitlines()))
    assert done.code == 2
    assert "programmed 640 of 640 bytes" in lines["a"]
    assert "programmed" in lines["b"]
    assert "FAILED (2): a link of 256 LEDs, native: has 96: HELLO says so" in lines["c"]
    assert "programmed 788 of 788 bytes" in lines["d"]  # 8 clusters, 692 chips


@pytest.mark.parametrize("pilot_every", [1, 4])
def test_what_a_board_composes_is_sent_chip_by_chip_where_it_is_too_slow(
    device: SimulatedBoard, board: Board, pilot_every: int
) -> None:
    object.__setattr__(board.about, "chip_rate_min_hz", 1282)
    link = load_link(overrides=["air.chip_rate_hz=1000.0", f"air.pilot_every={pilot_every}"])
    symbols = random_symbols(2, 10, link.codebook, np.random.default_rng(6))
    chips = symbol_chips(symbols, link.codebook, pilot_every)
    bank = bank_of(symbols, link)
    assert bank.format == Format.WORDS
    assert bank.chip_by_chip().duty == bank.duty
    provision(board, bank, Settings(duty_limit=0.6))
    device.run(800_000)
    rows = shown(device)
    wanted = np.repeat(np.repeat(chips, 6, axis=1), 2, axis=0)  # 2000 chips/s
    assert (rows == np.resize(wanted, rows.shape)).all()
    assert board.verify(bank) == 0
    assert not board.program(bank).swapped
    with board.stream(link) as stream:
        stream.send(symbols[0])
    rows = shown(device)
    packet = 2 * link.packet.packet_chips
    assert (rows[-packet:] == wanted[:packet]).all()
    masks = Bank.of_chips(chips, link.codebook, link.packet)
    provision(board, masks, Settings())
    assert board.status().hold == 2
