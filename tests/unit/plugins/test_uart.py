"""Characters of one LED, against a generator of events that shares nothing with the receiver."""

import itertools
import json
import math
from functools import cache

import numpy as np
import pytest
from evlcp_uart import _kernels
from evlcp_uart.decoder import CharacterState
from evlcp_uart.framing import Uart, read_characters
from evlcp_uart.inference import infer_format
from evlcp_uart.light import TICKS

import evlcp_sdk as evlcp
from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.compose import compose
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.recordings import merge_events
from evlcp_sdk.values import Events

BAR = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
BIT_504_US = 1e6 / 504


def levels_of(values, data_bits, parity, stop_bits, highest_first=False):
    """Bits on air of characters, by the textbook, or the highest bit first as home-made transmitters send."""
    out = []
    for value in values.tolist():
        data = [int(c) for c in f"{value:0{data_bits}b}"[:: 1 if highest_first else -1]]
        ones = sum(data) % 2
        check = {"none": [], "even": [ones], "odd": [1 - ones]}[parity]
        out += [0, *data, *check, *[1] * stop_bits]
    return out


def light_of_bytes(
    rng,
    levels,
    bit_us,
    *,
    mark_on=True,
    events=(80.0, 50.0),
    late_us=(60.0, 110.0),
    noise_hz=300.0,
    unseen=0.0,
    start_us=20_000.0,
    cut_bits=0.0,
):
    """What pixels make of the edges: Poisson bursts, log-normally late, noise, edges without a burst."""
    times, polarities = [], []
    before = 1
    for k, level in enumerate(levels):
        if level != before and rng.random() >= unseen:
            on = (level == 1) == mark_on
            many = rng.poisson((events[0] if on else events[1]) * rng.gamma(8) / 8)
            late = (late_us[0] if on else late_us[1]) * np.exp(0.5 * rng.standard_normal(many))
            times.append(start_us + k * bit_us + late)
            polarities.append(np.full(many, on))
        before = level
    end_us = start_us + (len(levels) + 30) * bit_us
    for on in (False, True):
        many = rng.poisson(noise_hz * end_us * 1e-6)
        times.append(rng.uniform(0, end_us, many))
        polarities.append(np.full(many, on))
    t, p = np.concatenate(times), np.concatenate(polarities)
    kept = t >= start_us + cut_bits * bit_us if cut_bits else np.ones(len(t), np.bool_)
    n = int(kept.sum())
    return merge_events(Events.of(np.floor(t[kept]), np.zeros(n), np.zeros(n), p[kept]))


def wrong_bits(found, sent, data_bits):
    return sum((a ^ b).bit_count() for a, b in zip(found, sent, strict=True)) / (data_bits * len(sent))


@pytest.mark.parametrize(
    ("bit_hz", "clock", "mark_on", "late_us"),
    [
        (3125.0, 0.01, True, (60.0, 110.0)),
        (3125.0, -0.025, False, (60.0, 350.0)),
        (504.0, 0.02, True, (200.0, 600.0)),
        (10_000.0, -0.01, True, (40.0, 60.0)),
    ],
)
def test_bright_light_is_read_without_an_error(bit_hz, clock, mark_on, late_us):
    rng = np.random.default_rng(3)
    sent = rng.integers(0, 128, 60)
    bit_us = 1e6 / bit_hz * (1 + clock)
    how = {"mark_on": mark_on, "late_us": late_us, "noise_hz": bit_hz / 10, "cut_bits": 4.4}
    events = light_of_bytes(rng, levels_of(sent, 7, "even", 2), bit_us, **how)
    uart = Uart(7, "even", 2, idle="on" if mark_on else "off")
    found = read_characters(events.t_us, events.p, bit_hz, uart)
    # The first one is cut.
    assert [c.value for c in found] == sent[1:].tolist()
    assert found[-1].bit_us == pytest.approx(bit_us, rel=2e-3)
    assert not any(c.wrong_parity for c in found)
    apart = np.diff([c.t_us for c in found])
    np.testing.assert_allclose(apart, 11 * bit_us, atol=bit_us / 5)


@pytest.mark.parametrize(
    ("seed", "first_us", "text"),
    [
        (5, 40, b"Shall I compare thee"),
        (5, -3_000_000, b"Shall I compare thee"),
        # Falls late by a fifth of a bit: characters a bit late explain more events, but no stop bits.
        (12, 0, b"y? Thou art more lovely and more temperate: rough winds do shake the darling bud"),
    ],
)
def test_a_list_is_read_from_its_first_character_wherever_time_begins(seed, first_us, text):
    levels = levels_of(np.frombuffer(text, np.uint8), 7, "even", 2)
    # Edges are seen late, so the first character begins before the first event.
    events = light_of_bytes(
        np.random.default_rng(seed), levels, BIT_504_US, late_us=(60.0, 400.0), noise_hz=0.0
    )
    t_us = events.t_us - events.t_us[0] + first_us
    found = read_characters(t_us, events.p, 504.0, Uart(7, "even", 2))
    # The rest of the last one's bits may not have been seen.
    assert bytes(c.value for c in found) == (text if seed == 5 else text[:-1])
    # It may start up to a bit before, as nothing was seen of the time before.
    assert -BIT_504_US <= found[0].t_us - first_us <= BIT_504_US / TICKS


@pytest.mark.parametrize(
    ("rate_hz", "events", "late_us", "grain_us"),
    [
        (504.0, (12.0, 12.0), (60.0, 110.0), 500),
        (3125.0, (500.0, 400.0), (190.0, 230.0), 90),
        (10_000.0, (60.0, 50.0), (25.0, 30.0), 25),
    ],
)
def test_times_that_are_coarse_are_read(rate_hz, events, late_us, grain_us):
    """As a list rounds them, or a camera reads its events out in bunches that shift against the bits."""
    sent = np.random.default_rng(1).integers(0, 128, 60)
    bit_us = 1e6 / rate_hz * 1.002
    rng, levels = np.random.default_rng(9), levels_of(sent, 7, "even", 2)
    light = light_of_bytes(rng, levels, bit_us, events=events, late_us=late_us)
    t_us, p = (light.t_us // grain_us + 1) * grain_us, light.p
    found = read_characters(t_us, p, rate_hz, Uart(7, "even", 2))
    starts = 20_000 + 11 * bit_us * np.arange(len(sent))
    at = {int(np.abs(starts - one.t_us).argmin()): one.value for one in found}
    assert len(at) == len(found) >= len(sent) - 1
    assert sum((value ^ int(sent[k])).bit_count() for k, value in at.items()) <= 1


@pytest.mark.parametrize("cut", [0, 3, 8])
def test_a_stream_that_begins_within_a_character_gives_none_that_was_not_sent(cut):
    """The next one may start at any bit that is 0: what could be read otherwise as well is left out."""
    rng = np.random.default_rng(cut)
    bit_us, pause = 100.0, 16
    sent = rng.integers(0, 256, 40)
    levels = []
    starts = []
    for k, value in enumerate(sent.tolist()):
        starts.append(len(levels))
        levels += levels_of(np.array([value]), 8, "even", 1) + [1] * (pause if k % 5 == 1 else 0)
    events = light_of_bytes(rng, levels, bit_us, late_us=(20.0, 30.0), noise_hz=0.0, start_us=0.0)
    later = events.t_us >= cut * bit_us
    decoder = Uart(8, "even", 1).make_decoder(1e6 / bit_us)
    until_us = int(events.t_us[-1] + 3 * pause * bit_us)
    state, found = decoder.step(CharacterState(), events.t_us[later], events.p[later], until_us)
    state, more = decoder.close(state)
    read = [(round(c.t_us / bit_us), c.value) for c in [*found, *more]]
    right = zip(starts, sent.tolist(), strict=True)
    assert set(read) <= {(at + near, value) for at, value in right for near in (-1, 0, 1)}
    assert len(read) >= len(sent) - 3
    assert state.tally["characters"] == len(read)


def test_the_pause_tells_characters_of_a_recording_that_begins_within_a_packet():
    """From within 35, 35 and 175 read as 246 and 253, too, and by their bits alone just as well."""
    packets = [[97, 119, 159, 35, 175], [28, 86, 233, 30, 5], [77, 124, 246, 18, 200], [3, 91, 44, 170, 66]]
    levels = []
    for packet in packets:
        levels += [1] * 16 + levels_of(np.array(packet), 8, "even", 1)
    # From the last data bit of the 35 on.
    cut_bits = 16 + 3 * 11 + 8.7
    dim = {"events": (20.0, 15.0), "late_us": (20.0, 10.0), "noise_hz": 0.0}
    events = light_of_bytes(np.random.default_rng(0), levels, 100.0, cut_bits=cut_bits, **dim)
    for pause_bits in (16, 9):
        found = read_characters(events.t_us, events.p, 1e4, Uart(8, "even", 1, pause_bits=pause_bits))
        read = [c.value for c in found]
        assert read[-15:] == [value for packet in packets[1:] for value in packet]
        # By the wrong pause it is ambiguous, or another.
        assert (175 in read) == (pause_bits == 16)


@cache
def dim(events, unseen, many):
    """Characters that were sent by a dim light, and those that are read."""
    rng = np.random.default_rng(17)
    sent = rng.integers(0, 128, many)
    light = light_of_bytes(rng, levels_of(sent, 7, "even", 2), DIM_BIT_US, events=events, unseen=unseen)
    return sent, read_characters(light.t_us, light.p, 3125.0, Uart(7, "even", 2))


DIM_BIT_US = 323.2
DIM = (4.0, 3.0), 0.03, 160


@pytest.mark.parametrize(("light", "best"), [(DIM, 40 / 1120), (((8.0, 6.0), 0.01, 150), 6 / 1050)])
def test_errors_are_those_of_a_receiver_that_knows_the_light(light, best):
    """Its best: it is told when each character starts, how late events are, and how many come."""
    sent, found = dim(*light)
    assert len(found) >= len(sent) - 2
    starts = np.array([c.t_us for c in found])
    due_us = 20_040 + 11 * DIM_BIT_US * np.arange(len(sent))
    ours = wrong_bits([found[np.abs(starts - at).argmin()].value for at in due_us], sent.tolist(), 7)
    # Three standard deviations of the difference, at two wrong bits a wrong character.
    assert ours <= 1.15 * best + 3 * math.sqrt(4 * best / (7 * len(sent)))


def test_llrs_tell_the_truth():
    sent, found = dim(*DIM)
    assert len(found) == len(sent)
    right = np.array([c.value for c in found]) == sent
    quality = np.array([c.quality for c in found])
    assert quality.mean() == pytest.approx(right.mean(), abs=0.05)
    assert quality[~right].mean() < 0.75
    wrong = np.array([c.wrong_parity for c in found])
    assert right[wrong].mean() < right[~wrong].mean()


@pytest.mark.parametrize(
    ("seed", "pause", "after_pause"), [(4, 0, 5.0), (4, 3, 2.0), (6, 3, 2.0), (6, 2, 4.5)]
)
def test_the_best_path_is_the_best_of_all(seed, pause, after_pause):
    rng = np.random.default_rng(seed)
    scores, tails = rng.normal(4, 6, 14), rng.normal(0, 2, 14)
    starts, score = _kernels.find_best_path(scores, tails, 4, 0, 1, 5.0, 1.0, 0.5, pause, after_pause)

    def cost(path):
        total = 0.0
        for k, s in enumerate(path):
            if not k:
                total += scores[s] - 5.0
                continue
            end = path[k - 1] + 4
            off, late = s - end, s - end - pause
            if off < -1:
                return -math.inf
            ways = [-1.0 - 0.5 * abs(off)] if off <= 1 else []
            ways += [tails[end] - 5.0] if off >= 0 else []
            ways += [tails[end] - after_pause - 0.5 * abs(late)] if pause and abs(late) <= 1 else []
            total += scores[s] + max(ways)
        return total

    every = [p for n in range(6) for p in itertools.combinations(range(14), n)]
    best = max(every, key=cost)
    assert score == pytest.approx(cost(best))
    assert tuple(starts.tolist()) == best


def _link(**air):
    air = {"chip_rate_hz": 3125.0, "frames_per_packet": 100} | air
    framing = {"id": "uart", "data_bits": 7, "parity": "even", "stop_bits": 2}
    return resolve({"bar": BAR, "air": air, "framing": framing, "detection": {"id": "whole"}})


def _received(link, events, size):
    receiver = Receiver(link)
    packets = [p for k in range(0, len(events), size) for p in receiver.feed(events[k : k + size])]
    return packets + receiver.close(), receiver.counts


def test_a_text_comes_through_the_receiver_in_any_pieces():
    link = _link()
    symbols = compose(link, text="Works ahead", transmitter_id=7, sequence=3)
    chips = np.concatenate([packet_chips(one, link.codebook)[:, 0] for one in symbols] * 2)
    events = light_of_bytes(np.random.default_rng(1), chips.tolist(), 323.0)
    packets, counts = _received(link, events, 4000)
    (message,) = [m for p in packets for m in p.messages]
    assert message.value == "Works ahead"
    assert [len(p.frames) for p in packets] == [100, 100]
    assert [p.packet for p in packets] == [0, 1]
    assert counts["characters"] == counts["frames"] == 200
    for packet in packets:
        assert [int(f.soft.symbols[0]) for f in packet.frames] == symbols[0][:, 0].tolist()
        assert all(math.isnan(f.range.distance_m) for f in packet.frames)
    again, _ = _received(link, events, 777)
    assert [repr(p) for p in again] == [repr(p) for p in packets]


@pytest.mark.parametrize("extra", [-8, 44])
def test_packets_behind_another_pause_than_is_stated_are_whole(extra):
    """44 bits more are four characters, by which a frame's place was off."""
    link, rng = _link(), np.random.default_rng(3)
    sent = rng.integers(0, 128, (6, 100, 1))
    stated = len(link.codebook.preamble)
    levels = [packet_chips(one, link.codebook)[stated:, 0].tolist() for one in sent]
    events = light_of_bytes(
        rng, [v for one in levels for v in [*[1] * (stated + extra), *one]], 320.0 * (1 + 1e-3)
    )
    packets, _ = _received(link, events, 4000)
    assert [(p.packet, [int(f.soft.symbols[0]) for f in p.frames]) for p in packets] == [
        (n, one[:, 0].tolist()) for n, one in enumerate(sent)
    ]
    tally = RunTally(link.packet)
    for packet in packets:
        tally.add(packet)
    assert tally.transmitters[0].clock_ppm() == pytest.approx(-1000, abs=100)


def test_a_long_pause_has_no_characters():
    """In its noise, and the light is found again behind it."""
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 128, (2, 60))
    words = [levels_of(one, 7, "even", 2) for one in (first, second)]
    events = light_of_bytes(rng, [*words[0], *[1] * 6000, *words[1]], 320.0)
    found = read_characters(events.t_us, events.p, 3125.0, Uart(7, "even", 2))
    assert [c.value for c in found] == [*first, *second]


def test_a_bar_of_clusters_is_refused():
    with pytest.raises(ConfigError, match="framing 'uart': a bar of 16 clusters, expected one"):
        resolve({"framing": {"id": "uart"}})


def receive_list(evlcp, folder, events, query="", **framing):
    """What `receive` prints of a list of times and polarities, and its summary."""
    rows = "".join(f"{t},{p}\n" for t, p in zip(events.t_us.tolist(), events.p.tolist(), strict=True))
    (folder / "list.csv").write_text("t,p\n" + rows)
    settings = {"bar.rows": 6, "detection.id": "whole", "framing.id": "uart", "air.chip_rate_hz": 3125.0}
    settings |= {"air.frames_per_packet": 40} | {f"framing.{key}": value for key, value in framing.items()}
    given = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
    run = evlcp("receive", f"list:{folder}/list.csv{query}", "-o", f"{folder}/out", *given)
    assert run.code == 0
    return run.out, json.loads((folder / "out" / "summary.json").read_text())


SEVEN_EVEN = {"data_bits": 7, "parity": "even", "stop_bits": 2}


def test_text_is_given_as_it_is_read(tmp_path, evlcp):
    """The highest bit first; and what is said where it is not told."""
    text = "Rough winds do shake the darling buds of May, " * 3
    levels = levels_of(np.frombuffer(text.encode(), np.uint8), 7, "even", 2, True)
    events = light_of_bytes(np.random.default_rng(2), levels, 320.0)
    printed, summary = receive_list(evlcp, tmp_path, events, first_bit="highest", **SEVEN_EVEN)
    assert "text of 0: 'Rough winds do shake" in printed
    lines = [json.loads(line) for line in (tmp_path / "out" / "packets.jsonl").read_text().splitlines()]
    # Of the last packet only the first characters were sent.
    assert "".join(line["text"] for line in lines).rstrip("\ufffd") == text
    assert [one["text"] for one in summary["transmitters"]] == [text]
    assert summary["warnings"] == []
    _, summary = receive_list(evlcp, tmp_path, events, **SEVEN_EVEN)
    assert [one["code"] for one in summary["warnings"]] == ["bit-order"]


@pytest.mark.parametrize(
    ("data_bits", "parity", "stop_bits", "bit_hz", "mark_on", "idle"),
    [
        (7, "even", 2, 3125.0, True, "off"),
        (8, "none", 1, 504.0, False, "on"),
        (5, "none", 1, 3125.0, True, "on"),
        (9, "odd", 2, 3125.0, False, "off"),
    ],
)
def test_a_light_the_other_way_round_is_read(data_bits, parity, stop_bits, bit_hz, mark_on, idle):
    rng = np.random.default_rng(data_bits + mark_on)
    sent = rng.integers(0, 1 << data_bits, 70)
    bit_us = 1e6 / bit_hz
    levels = levels_of(sent, data_bits, parity, stop_bits)
    assert Uart(data_bits, parity, stop_bits).codebook(1).codewords[sent].ravel().tolist() == levels
    events = light_of_bytes(rng, levels, bit_us, mark_on=mark_on, late_us=(40.0, 60.0), noise_hz=50.0)
    decoder = Uart(data_bits, parity, stop_bits, idle=idle).make_decoder(bit_hz)
    state, found = decoder.step(CharacterState(), events.t_us, events.p, int(events.t_us[-1]))
    state, more = decoder.close(state)
    assert [c.value for c in found + more] == sent.tolist()
    assert state.tally["frames_inverted"] == (len(sent) if (idle == "on") != mark_on else 0)


@pytest.mark.parametrize("clock", [-0.025, 0.02])
def test_a_text_is_read_from_its_first_stretch_on_whatever_the_clock(clock):
    """A few characters follow the part that is learned from, and fit from another bit on, too."""
    text = b"rag thou wander'st in his shade, When in eternal lines to time thou grow'st: So long as men can "
    sent = np.frombuffer(text + b"brea", np.uint8).astype(np.int64)
    levels = levels_of(sent, 7, "even", 2, True)
    rng = np.random.default_rng(1001)
    rng.integers(0, 500)
    bit_us, cut = 320 * (1 + clock), float(rng.uniform(0, 11))
    light = light_of_bytes(rng, levels, bit_us, events=(14.0, 11.0), unseen=0.001, cut_bits=cut)
    found = read_characters(light.t_us, light.p, 3125.0, Uart(7, "even", 2, first_bit="highest"))
    assert found[0].bit_us == pytest.approx(bit_us, rel=1e-3)
    assert wrong_bits([one.value for one in found[-98:]], sent[-98:].tolist(), 7) < 0.01


def test_what_a_list_has_wrong_is_reported(tmp_path, evlcp):
    """Polarities that are turned, or of one kind alone; and what the list did not say."""
    sent = np.random.default_rng(4).integers(0, 128, 60)
    events = light_of_bytes(np.random.default_rng(3), levels_of(sent, 7, "even", 2), 320.0)

    def told(kept, query=""):
        return receive_list(evlcp, tmp_path, kept, query, **SEVEN_EVEN)[1]

    turned = Events.of(events.t_us, events.x, events.y, 1 - events.p)
    inverted = told(turned)
    assert [one["code"] for one in inverted["warnings"]] == ["polarity"]
    assert inverted["counts"]["frames_inverted"] == inverted["counts"]["frames"] == 60
    assert "times in us, guessed" in next(n["text"] for n in inverted["notes"] if n["code"] == "guessed")
    right = told(turned, "?inverted=1&unit=us")
    assert right["warnings"] == []
    assert "guessed" not in [one["code"] for one in right["notes"]]
    assert right["recording"]["guessed"] == ""
    (on,) = (one for one in told(events[events.p > 0])["warnings"] if one["code"] == "one-polarity")
    assert "events are ON: when the light goes off is not seen" in on["text"]


def test_a_lamp_that_reads_as_one_character_is_reported(tmp_path, evlcp):
    """A period of ten bits, half of it dark: 8N1 reads 0xF0 for ever. A text with blanks is none."""

    def warnings_of(levels):
        return receive_list(evlcp, tmp_path, light_of_bytes(np.random.default_rng(3), levels, 320.0))[1][
            "warnings"
        ]

    lamp = warnings_of([1, *[0, 0, 0, 0, 0, 1, 1, 1, 1, 1] * 120])
    (reported,) = (one["text"] for one in lamp if one["code"] == "one-character")
    assert "characters are 0xf0: a lamp that blinks once in a character's time" in reported
    assert warnings_of(levels_of(np.frombuffer(b"to be or not" * 10, np.uint8), 8, "none", 1)) == []


@pytest.mark.parametrize(
    ("data_bits", "parity", "stop_bits", "bit_hz", "mark_on", "clock", "light"),
    [
        (7, "even", 2, 3125.0, True, 0.01, {"late_us": (160.0, 260.0), "cut_bits": 13.7}),
        (7, "even", 2, 3125.0, True, 0.0, {"events": (4.0, 3.0), "unseen": 0.03}),
        (8, "odd", 1, 20_000.0, False, 0.0, {"late_us": (25.0, 30.0)}),
        (7, "none", 1, 300.0, False, -0.02, {}),
        (8, "none", 1, 9600.0, True, 0.0, {"late_us": (40.0, 60.0)}),
    ],
)
def test_rate_and_format_of_a_light_are_found(data_bits, parity, stop_bits, bit_hz, mark_on, clock, light):
    rng = np.random.default_rng(2)
    levels = levels_of(rng.integers(0, 1 << data_bits, 90), data_bits, parity, stop_bits)
    light = {"mark_on": mark_on, "noise_hz": bit_hz / 10, "start_us": 2e6} | light
    events = light_of_bytes(rng, levels, 1e6 / bit_hz / (1 + clock), **light)
    found, _ = infer_format(events.t_us, events.p)
    assert found.pop("air.chip_rate_hz") == pytest.approx(bit_hz * (1 + clock), rel=1e-3)
    assert found.pop("framing.first_bit") == "lowest"
    expected = {"data_bits": data_bits, "parity": parity, "stop_bits": stop_bits}
    expected |= {"idle": "on" if mark_on else "off"}
    assert found == {f"framing.{key}": value for key, value in expected.items()}


def light_of(kind):
    """What is no asynchronous light: bits without a frame, or that repeat themselves."""
    rng = np.random.default_rng(4)
    bits = rng.integers(0, 2, 800)
    levels = {
        "random bits": bits,
        "pair codes": np.stack([bits, 1 - bits], 1).ravel(),
        "a lamp": np.tile([0, 1], 800),
        "PWM": np.tile([1] + [0] * 9, 160),
        "a pattern": np.tile(bits[:37], 40),
        "no light": np.ones(1600, np.int64),
    }[kind]
    return light_of_bytes(rng, levels.tolist(), 250.0, late_us=(40.0, 60.0))


@pytest.mark.parametrize("kind", ["random bits", "pair codes", "a lamp", "PWM", "a pattern", "no light"])
def test_other_light_is_no_asynchronous_one(kind):
    events = light_of(kind)
    found, reported = infer_format(events.t_us, events.p)
    assert found == {}
    assert reported.startswith("no asynchronous light found: at best ")


def test_a_list_is_received_without_a_link(tmp_path, evlcp):
    text = "Rough winds do shake the darling buds of May, " * 3
    codes = np.frombuffer(text.encode(), np.uint8).astype(int)
    turned = np.array([int(f"{code:07b}"[::-1], 2) for code in codes.tolist()])
    light = light_of_bytes(np.random.default_rng(2), levels_of(turned, 7, "even", 2), 320.0)
    np.savez(tmp_path / "light.npz", t_us=light.t_us, p=light.p)
    run = evlcp("receive", tmp_path / "light.npz", "-o", tmp_path / "out", "--link", "auto")
    assert "3125 baud, 7 data bits highest first, even parity, 2 stop bits: 7E2, idle on, 13" in run.err
    assert "Rough winds do shake the darling buds" in run.out
    assert "light: an asynchronous light, 3125 baud" in evlcp("diagnose", tmp_path / "light.npz").out


@pytest.mark.parametrize("seed", [3, 7])
def test_pair_codes_without_a_parity_to_fail_are_none_of_characters(seed):
    """What fits of them is as dim as it is wrong: the rest of the light speaks against it."""
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 2, 260)
    levels = np.stack([values, 1 - values], 1).ravel().tolist()
    light = light_of_bytes(rng, levels, 100.0, late_us=(20.0, 30.0), noise_hz=100.0)
    assert read_characters(light.t_us, light.p, 10_000.0, Uart(8, "none", 1)) == []


@pytest.mark.parametrize(
    "framing", [{}, {"parity": "even"}, {"data_bits": 7, "parity": "even", "stop_bits": 2}]
)
def test_a_bar_in_view_is_no_light_of_characters(framing, demo_raw):
    """By a link at the bar's own rate of chips; nor is it ever taken for one, which costs much time."""
    one = {"rows": 1, "columns": 1, "cluster_rows": 1, "cluster_columns": 1}
    link = resolve({"bar": one, "framing": {"id": "uart"} | framing, "air": {"frames_per_packet": 100}})
    with evlcp.receive(demo_raw, [link]) as packets:
        assert list(packets) == []
        assert packets.counts["regions_opened"] == 0
