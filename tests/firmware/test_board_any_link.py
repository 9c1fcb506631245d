"""Any link on a board, LED by LED: other bars, other codes, characters, chips as they are."""

import zlib
from dataclasses import replace

import numpy as np
import pytest
from board_lines import (
    LINK,
    board_link,
    board_on,
    check_fault,
    options_of,
    shown_chips,
    some_bank,
    symbols_of,
    well,
)
from hypothesis import given, settings, strategies as st

from evlcp_sdk.air.codebook import Codebook, hadamard
from evlcp_sdk.air.frames import PacketFormat, packet_chips
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.bar import BarLayout, LedTable
from firmware_host.board.bank import Bank, make_bank, random_packets, symbol_chips
from firmware_host.board.board import Settings, profile_number, provision
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import IncompatibleError, RefusedError
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import BoardFault, Format, Profile, Status

SIZES = (3, 14, 1, 9, 9, 20, 6, 2, 12, 11)
LED_CLUSTERS = np.random.default_rng(4).permutation(np.repeat(np.arange(10), SIZES))
"""87 LEDs in ten clusters of other sizes, side by side in no order: the cluster of each LED."""


def book_of(clusters, values):
    """Codes of `2 * values` chips, drawn at random."""
    rng = np.random.default_rng(values)
    codes = np.unique(rng.choice(np.array([-1, 1], np.int8), (4 * clusters + 64, values)), axis=0)
    codes = rng.permutation(codes)
    preamble = rng.choice(np.array([-1, 1], np.int8), 40)
    return Codebook.of_values("drawn", preamble, codes[:clusters], codes[clusters : clusters + 16])


BOOK = book_of(10, 12)


def link_of(book, packet, led_clusters=LED_CLUSTERS):
    """A link with codes, a packet and LEDs of one's own."""
    leds = tuple((0.0, i / 100, 0.0, int(cluster)) for i, cluster in enumerate(led_clusters))
    return replace(LINK, codebook=book, packet=packet, bar=BarLayout(LedTable(leds)))


DRAWN = link_of(BOOK, PacketFormat.of(BOOK, 3, pilot_every=2))
SYMBOLS = random_packets(2, DRAWN, 1)


def a_bank(**changes):
    return make_bank(SYMBOLS, replace(DRAWN, packet=replace(DRAWN.packet, **changes)))


def leds_of(chips, led_clusters):
    """What the 96 outputs do for chips of clusters, uint8 (chips, 96); without the code that is tested."""
    found = np.zeros((len(chips), 96), np.uint8)
    for led, cluster in enumerate(led_clusters):
        found[:, led] = chips[:, cluster]
    return found


def check_round(rows, expected, least):
    """Rows are these LEDs', round and round, and none beyond them is lit."""
    assert len(rows) >= least
    leds = expected.shape[1]
    assert (rows[:, :leds] == np.resize(expected, (len(rows), leds))).all()
    assert not rows[:, leds:].any()


EXPECTED = leds_of(symbol_chips(SYMBOLS, DRAWN), LED_CLUSTERS)
"""80 chips of preamble, two pilots and three words of 24: twice."""


def check_plays(device, board, bank, leds):
    """The board takes a bank, within the very share of time that it has a LED on, and its LEDs play it."""
    share = np.ceil(1000 * leds.mean(0).max() - 1e-9)
    done = provision(board, bank, Settings(duty_limit=share / 1000))
    assert (done.written, done.swapped) == (len(bank.content), True)
    device.run(400_000)
    record = device.take_led_record().select_chips()
    check_round(record.chips(None), leds, len(leds) + 1)
    assert (record.numbers == np.arange(len(record))).all()
    assert (np.diff(record.ticks) == device.TICK_HZ // bank.chip_rate_hz).all()
    status = board.status()
    assert status.duty == bank.duty == share
    assert (status.packet_chips, status.faults) == (bank.link.packet.packet_chips, 0)
    assert board.verify(bank) == status.active_bank
    assert provision(board, bank, Settings()).written == 0


EDGES = ("separation.id=edges", "decoding.id=edges")
DIMMED = ("modulation.id=wh4x2-dimmed", "pilots.id=wh-dimmed")
ONE_LED = ("bar.rows=1", "bar.cluster_rows=1", "ranging.id=none")


@pytest.mark.parametrize(
    ("form", "overrides"),
    [
        (Format.WORDS, ()),
        (Format.WORDS, ("modulation.id=wh8",)),
        (Format.WORDS, ("modulation.id=raw8",)),
        (Format.WORDS, ("air.pilot_every=4",)),
        (Format.WORDS, ("air.frames_per_packet=3", "air.pilot_every=64")),
        (Format.CLUSTERS, (*EDGES, "modulation.id=nrz", "air.chip_rate_hz=20000.0")),
        (Format.CLUSTERS, (*EDGES, "modulation.id=ppm")),
        (Format.CLUSTERS, (*EDGES, *DIMMED)),
        (Format.CLUSTERS, (*EDGES, *ONE_LED, "modulation.id=nrz")),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else value.name,
)
def test_every_led_does_what_it_is_sent(device, board, form, overrides):
    link = board_link(*overrides)
    symbols = symbols_of(2, 1, link)
    chips = np.concatenate([packet_chips(one, link.codebook, link.packet.pilot_every) for one in symbols])
    bank, leds = make_bank(symbols, link), leds_of(chips, link.bar.led_clusters())
    assert bank.format == form
    check_plays(device, board, bank, leds)
    # a stream, whose idle pattern is no brighter and of the bar's LEDs alone, keeps to the same limit
    with board.stream(link) as stream:
        stream.wait(0.1)
        for packet in symbols:
            stream.send(packet)
    rows = shown_chips(device)
    assert (rows[-len(leds) :] == leds).all()
    assert not rows[:, len(link.bar.led_clusters()) :].any()
    assert board.status().faults == 0


def test_own_codes_are_composed_too(device, board):
    rows, values = hadamard(8), np.array([1, 1, 1, -1, 1], np.int8)
    book = Codebook.of_values("wh8", values, np.concatenate([-rows, rows]), rows)
    link = replace(LINK, codebook=book, packet=PacketFormat.of(book, 3))
    symbols = random_packets(2, link, 0)
    bank = make_bank(symbols, link)
    assert (bank.format, profile_number(bank)) == (Format.WORDS, Profile.CUSTOM)
    check_plays(device, board, bank, np.repeat(symbol_chips(symbols, link), 6, axis=1))


@given(st.data())
@settings(max_examples=25, deadline=None)
def test_any_clusters_of_any_leds(data):
    """Clusters of any number and order, chips of any kind and length: every LED against NumPy."""
    device = SimulatedBoard()
    board = board_on(device)
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    clusters = data.draw(st.sampled_from([1, 2, 7, 8, 9, 15, 16, 17, 31, 33, 64, 88, 89, 96]))
    leds = data.draw(st.integers(clusters, 96))
    which = rng.permutation([*range(clusters), *rng.integers(0, clusters, leds - clusters)])
    packet = replace(PacketFormat.of(book_of(clusters, 8), 1), preamble_chips=data.draw(st.integers(1, 40)))
    packets = data.draw(st.integers(1, 5))
    chips = rng.integers(0, 2, (packets * packet.packet_chips, clusters), dtype=np.uint8)
    bank = Bank.of_chips(chips, link_of(book_of(clusters, 8), packet, which))
    assert bank.format == (Format.CLUSTERS if clusters <= 88 else Format.MASKS)
    provision(board, bank, Settings())
    device.run(data.draw(st.integers(1, 400)) * 100)
    assert board.verify(bank) == 0
    check_round(shown_chips(device), leds_of(chips, which), 1)
    assert board.status().duty == bank.duty == np.ceil(1000 * chips.mean(0).max() - 1e-9)


@pytest.mark.parametrize(("limit", "every"), [(0.5, 2), (0.3, 4), (0.001, 1000)])
def test_idle_keeps_to_the_limits(device, board, limit, every):
    """LEDs are on for no more of it than they may be, whatever the length of a packet."""
    packet = replace(PacketFormat.of(BOOK, 1), preamble_chips=103)
    bank = Bank.of_chips(np.zeros((151, 10), np.uint8), link_of(BOOK, packet))
    provision(board, bank, Settings(watchdog="idle", watchdog_ms=100, duty_limit=limit))
    device.run(700_000)
    on = np.flatnonzero(shown_chips(device)[:, 0])
    assert (np.diff(on) == every).all()
    assert len(on) >= 5
    assert on[0] % 151 == every - 1 if every < 151 else True
    assert board.status().faults == BoardFault.WATCHDOG


def test_what_the_firmware_refuses(device, board):
    call, bank = board.session.call, a_bank()
    digest = bank.digest
    chips = protocol.ChipsRequest(200, 1, 10, digest)
    for name, wrong, nearest in (
        *[("packet_chips", n, near) for n, near in ((0, 1), (40961, 40960), (2**32 - 1, 40960))],
        *(("hold", 0, 1), ("clusters", 97, 96)),
    ):
        with pytest.raises(RefusedError) as caught:
            call(replace(chips, **{name: wrong}))
        assert (caught.value.status, caught.value.detail) == (Status.OUT_OF_RANGE, nearest)
    commit = protocol.CommitRequest(0, bank.format, 2, len(bank.content), bank.crc, digest)
    with pytest.raises(RefusedError):
        call(commit)  # CLUSTERS with a codebook
    board.prepare_commit(bank)
    board.write_missing(0, bank.content)
    for name, wrong in (
        *[("format", form) for form in (Format.WORDS, Format.MASKS, 3)],
        *[("packets", count) for count in (0, 3, 65535)],
        ("length", len(bank.content) - 2),
        ("digest", bytes(32)),
    ):
        with pytest.raises((RefusedError, IncompatibleError)):
            call(replace(commit, **{name: wrong}))
    # an LED of two clusters would be on for longer than either
    overlapping = bytearray(bank.content)
    overlapping[12] |= overlapping[0]
    overlapping[13] |= overlapping[1]
    board.write_missing(0, bytes(overlapping))
    with pytest.raises(RefusedError) as caught:
        board.session.call(replace(commit, crc=zlib.crc32(overlapping)))
    assert (caught.value.status, caught.value.detail) == (Status.OUT_OF_RANGE, 1)
    with pytest.raises(RefusedError):
        board.session.call(protocol.StreamRequest(0, Format.CLUSTERS, commit.digest))
    board.prepare_commit(bank)
    device.run(10_000)
    assert not any(device.bench.shown)


def test_what_hello_says_decides(board):
    def change_hello(**changes):
        for name, value in changes.items():
            object.__setattr__(board.info, name, value)

    with pytest.raises(RefusedError, match=r"no chip rate of 7777 Hz: must divide 10000000 Hz, at least 1,"):
        board.program(a_bank(chip_rate_hz=7777))
    requests = board.status().requests
    panel = board_link("bar.rows=16", "bar.columns=16", "bar.cluster_rows=4", "bar.cluster_columns=4")
    with pytest.raises(ConfigError, match=r"a link of 256 LEDs, simulated: has 96: HELLO says so"):
        board.program(some_bank(link=panel))
    with pytest.raises(ConfigError, match=r"a link of 256 LEDs"):
        board.stream(panel)
    change_hello(leds=48, clusters=8)
    with pytest.raises(ConfigError, match=r"a link of 87 LEDs, simulated: has 48"):
        board.program(a_bank())
    # a firmware of before says nothing of formats
    change_hello(leds=96, clusters=16, formats=0, minor=1)
    with pytest.raises(IncompatibleError) as caught:
        board.program(a_bank())
    assert str(caught.value) == (
        "simulated:: its firmware (protocol 2.1) plays packets that it composes alone:"
        " of 96 LEDs in 16 equal clusters, codes of 16 chips, a preamble of at most 32; update the firmware"
    )
    assert board.status().requests == requests + 1


def test_chips_that_the_board_has_none_as_long_as(device, board):
    object.__setattr__(board.info, "chip_rate_min_hz", 1282)
    link = board_link("air.chip_rate_hz=1000.0", "air.pilot_every=4")
    symbols = symbols_of(2, 6, link)
    bank = make_bank(symbols, link)
    assert (bank.format, bank.to_chip_format().duty) == (Format.WORDS, bank.duty)
    provision(board, bank, Settings(duty_limit=0.6))
    status = board.status()
    assert (status.chip_rate_hz, status.hold) == (2000, 2)
    device.run(800_000)
    wanted = symbol_chips(symbols, link).repeat(6, axis=1).repeat(2, axis=0)
    check_round(shown_chips(device), wanted, 1500)
    assert board.verify(bank) == 0
    assert not board.program(bank).swapped
    with board.stream(link) as stream:
        stream.send(symbols[0])
    packet = 2 * link.packet.packet_chips
    assert (shown_chips(device)[-packet:] == wanted[:packet]).all()


ANY = ("bar.rows=90", "bar.cluster_rows=9", "pilots.id=barker13")
OPTIONS = options_of(*ANY)


def test_the_commands(evlcp, tmp_path, device, board):
    link = board_link(*ANY)
    symbols = symbols_of(2, 3, link)
    provision(board, make_bank(symbols, link), Settings())
    device.run(200_000)
    record, out = tmp_path / "leds.bin", tmp_path / "chips.npy"
    record.write_bytes(device.take_led_record().to_bytes())
    well(evlcp("board", "leds", record, "--chips", out, *OPTIONS))
    chips, whole = np.load(out), symbol_chips(symbols, link)
    assert (chips == np.resize(whole, chips.shape)).all()
    assert len(np.load(tmp_path / "chips.ticks.npy")) == len(chips)
    well(evlcp("board", "leds", record, "--chips", out, "--per-led"))
    assert (np.load(out)[:, :90] == np.repeat(chips, 9, axis=1)).all()
    # those chips are what a board is sent for the same link, column by column
    np.save(out, whole)
    for options in (("--masks", out), ("--random", 2, "--seed", 3)):
        done = evlcp("board", "--port", "native:", "program", *options, *OPTIONS)
        assert (done.code, done.err) == (0, ""), done.err
        assert f"of {10 * 12 + 2 * len(whole)} bytes" in done.out
    for rows, cluster_rows, message in (
        (80, 8, "LED 80 is lit, the link's bar has 80"),
        (90, 6, "the LEDs of cluster 4 differ; take every LED for itself with --per-led"),
    ):
        other = options_of(f"bar.rows={rows}", f"bar.cluster_rows={cluster_rows}")
        check_fault(evlcp("board", "leds", record, "--chips", out, *OPTIONS[4:], *other), 3, message)


# -- characters, by the test's own encoder

TEXT = b"Tempo 30!"
LAMP = ["bar.rows=6", "bar.columns=1", "bar.cluster_rows=6", "bar.cluster_columns=1"]
SERIAL = [*LAMP, "framing.id=uart", "framing.data_bits=7", "framing.parity=even", "framing.stop_bits=2"]


@pytest.fixture
def serial():
    """A link, a packet's symbols, and its chips: 7E2 as a serial port sends it behind a pause of 16 bits."""
    chips = [1] * 16
    for byte in TEXT:
        data = [byte >> k & 1 for k in range(7)]
        chips += [0, *data, sum(data) % 2, 1, 1]
    link = board_link(*SERIAL, f"air.frames_per_packet={len(TEXT)}")
    return link, np.array(list(TEXT))[:, None], np.array(chips, np.uint8)


def test_the_image_of_the_part_plays_any_clusters_too(stm32):
    """The image as it is flashed; rows as they are latched, from the first lit one on."""
    from tests.models.stm32 import US, Dma, lit_rows

    chip, board = stm32()
    assert board.info.chip_rate_min_hz == 1282  # chips of 0.78 ms
    provision(board, a_bank(), Settings(start=False))
    begin = len(chip.drivers.log)
    board.start()
    chip.run(15_000)
    rows, _ = lit_rows(chip.drivers.log[begin:])
    check_round(rows, np.roll(EXPECTED, -int(EXPECTED.any(1).argmax()), axis=0), 100)
    assert chip.longest[16 + Dma.IRQ] < 12 * US


def test_a_stream_rests_while_nothing_is_sent(serial, device, board):
    """The board's idle pattern would be characters: packets of pause keep it from being shown."""
    link, symbols, packet_chips = serial
    with board.stream(link) as stream:
        stream.wait(0.05)
        assert stream.send(symbols) == 0
        stream.wait(0.1)
        assert [stream.send(symbols) for _ in range(3)] == [1, 2, 3]
        assert stream.pauses > 5
    assert (stream.underruns, stream.sent) == (0, 4)
    chips = device.take_led_record().select_chips().chips(link.bar.led_clusters())
    packets = chips.reshape(-1, len(packet_chips))
    sent = (packets == packet_chips).all(1)
    assert (packets[~sent] == 1).all(), "the level of a pause"
    assert sent.sum() == 4
    assert np.flatnonzero(sent)[0] >= 3, "it rests from the first chip on"
    assert sent[-3:].all(), "behind one another"
    assert not any(device.bench.shown)


def test_what_would_be_characters_is_refused(serial, board):
    link, symbols, _ = serial
    bank = make_bank(symbols[None], link)
    with pytest.raises(ConfigError, match="watchdog = idle: LEDs that are on for a chip of two say"):
        provision(board, bank, Settings(watchdog="idle"))
    provision(board, bank, Settings(watchdog="dark", duty_limit=0.8, start=False))
    with pytest.raises(RefusedError, match="a pause of this link has a LED on for 1 of the time, the duty"):
        board.stream(link)
