"""`evlcp tx message` and `evlcp board stream`: what they write and play says what it was told to say."""

import json
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from board_lines import LINK, SITE, check_fault, packets_shown, well
from test_board_cli import EVLCP

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind, Message, join_parts
from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.air.kinds import CountdownKind, TimeKind
from firmware_host.emulators.led_record import RECORD, LedRecord

TILTED = f"{SITE}heading_deg = 90.0\ntilt_deg = 1.5\n"


@pytest.fixture
def site(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text(TILTED)
    return path


def symbols_of(chips, link=LINK):
    """Symbols (packets, frames, clusters) of chips that begin with a packet."""
    packet, words = link.packet, link.codebook.codewords
    whole = chips[: len(chips) // packet.packet_chips * packet.packet_chips]
    ends = [packet.frame_start_chip(frame + 1) for frame in range(packet.frames)]
    info = np.array([range(end - packet.info_chips, end) for end in ends])
    segments = whole.reshape(-1, packet.packet_chips, link.codebook.clusters)[:, info].swapaxes(2, 3)
    return (segments[:, :, :, None] == words).all(4).argmax(3)


def messages_of(symbols, link=LINK):
    """The messages that packets carry, each whole, by kind."""
    coder = link.block_coder()
    parts = {}
    for packet in symbols:
        bits = bits_of_symbols(packet, link.codebook.bits_per_symbol)
        content = coder.decode_block((4 - 8.0 * bits).astype(np.float32))
        assert content is not None
        block = Block.unpack(content)
        assert block.codebook == coder.digest
        parts.setdefault(block.kind, {})[block.index] = block
    found = {}
    for kind, blocks in parts.items():
        payload = join_parts([blocks[i].part for i in range(len(blocks))], blocks[0].length)
        found[kind] = Message(kind, blocks[0].transmitter_id, blocks[0].sequence, payload)
    return found


def packets_on(leds):
    """Symbols of the packets that a board showed; what is between them is left out."""
    return symbols_of(np.concatenate(packets_shown(LedRecord.read(leds).select_chips().chips())[0]))


def test_a_text_a_file_and_a_beacon(evlcp, site, tmp_path):
    data, out, chips = tmp_path / "data.bin", tmp_path / "m.json", tmp_path / "c.npy"
    data.write_bytes(bytes(range(100)))
    sent = ("--text", "Tempo 30 für 2 km", "--file", data, "--beacon", site, "--user", "lane 2")
    done = well(evlcp("tx", "message", *sent, "--sequence", "5", "-o", out, "--chips", chips))
    assert done.out.splitlines() == [
        "beacon       34 bytes, transmitter 7, sequence 5",
        "text         18 bytes, transmitter 7, sequence 5",
        "data        100 bytes, transmitter 7, sequence 5",
        f"5 packets, 0.173 s, in {out} and {chips}",
    ]
    table = json.loads(out.read_text())
    assert (table["link"]["modulation"]["id"], table["codebook"]) == ("wh4x2", LINK.codebook.digest)
    found = messages_of(np.array(table["symbols"]))
    assert found[Kind.TEXT] == Message(Kind.TEXT, 7, 5, "Tempo 30 für 2 km".encode())
    assert found[Kind.DATA].payload == bytes(range(100))
    beacon = Beacon.unpack(found[Kind.BEACON].payload)
    assert beacon == Beacon(35.156789, 136.965432, 52.4, 90.0, 1.5, 0.96, b"lane 2")
    assert (symbols_of(np.load(chips)) == table["symbols"]).all()


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--text", "a\udcff"), 2, "--text: character 2 is not UTF-8"),
        (("--beacon", "two.toml", "--id", "7", "--user", "\udcff"), 2, "--user: character 1 is not UTF-8"),
        (("--text", "a", "--user", "b"), 2, "--key and --user belong to a beacon"),
        (("--file", "no"), 3, "no: cannot be read"),
        (("--beacon", "two.toml"), 2, "2 bars: choose one with --id, of 7, 8"),
        (("--text", "a", "--set", "air.frames_per_packet=2"), 2, "expected at least 18"),
        (("--text", "a", "-o", "."), 1, "cannot be written"),
        (("--text", "a", "--every", "1"), 2, "--every sends to a board: give --port"),
        (("--text", "a", "--every", "1", "-o", "m.json"), 2, "-o and --chips hold what stays"),
        (("--text", "a", "--count", "3"), 2, "--count belongs to --every"),
        (("--countdown", "3", "--signal", "blue", "--every", "1", "--port", "native:"), 2, "signal = 'blue'"),
        (("--text", "a" * 8000, "--every", "1", "--port", "native:"), 2, "201 packets of 34.6 ms; give"),
    ],
)
def test_faults_are_one_line(evlcp, tmp_path, monkeypatch, options, code, message):
    monkeypatch.chdir(tmp_path)
    Path("two.toml").write_text(TILTED + TILTED.replace("= 7", "= 8"))
    check_fault(evlcp("tx", "message", *options), code, message)
    well(evlcp("tx", "message", "--beacon", "two.toml", "--id", 8, "--json"))


def test_what_tx_wrote_tx_shows(evlcp, tmp_path):
    out, chips, again = tmp_path / "m.json", tmp_path / "c.npy", tmp_path / "again.npy"
    (tmp_path / "link.toml").write_text('[pilots]\nid = "barker13"\n')
    options = ("--set", "pilots.id=barker13")
    well(evlcp("tx", "message", "--text", "hi", "-o", out, "--chips", chips, *options))
    for named in ((), options, ("-c", tmp_path / "link.toml"), (*options, "--set", "camera.focal_mm=50.0")):
        well(evlcp("tx", "frames", out, "--chips", again, *named))
        assert (np.load(again) == np.load(chips)).all()
        again.unlink()
        well(evlcp("tx", "check", out, *named))
    # a word is the chips, most significant first: the first pilot stands behind the preamble
    word = evlcp("tx", "frames", out, "--format", "json").out
    bits = "".join(str(chip) for chip in np.load(chips)[26:52, 0])
    assert int(json.loads(word)["pilot_words"][0], 16) == int(bits, 2)


@pytest.mark.parametrize(
    ("other", "differ"),
    [
        ("modulation.id=wh8", 'modulation.id: sent with "wh4x2", received with "wh8"'),
        ("error-correction.id=reed-solomon", "error-correction.id: sent with"),
    ],
)
def test_another_link_is_refused_and_says_where(evlcp, tmp_path, other, differ):
    out = tmp_path / "m.json"
    well(evlcp("tx", "message", "--text", "hi", "-o", out, "--set", "pilots.id=barker13"))
    done = evlcp("tx", "frames", out, "--set", "pilots.id=barker13", "--set", other)
    check_fault(done, 8, f"evlcp: {out}: made with another link: ", differ)
    assert done.out == ""


def test_without_an_output_nothing_is_sent(evlcp, monkeypatch, tmp_path):
    done = evlcp("tx", "message", "--text", "hi")
    message = "evlcp: nothing is sent or written: give --port (or EVLCP_PORT), -o or --chips\n"
    check_fault(done, 2, message)
    assert done.out.splitlines()[-1] == "1 packet, 0.0346 s"
    well(evlcp("tx", "message", "--text", "hi", "--json"))
    monkeypatch.setenv("EVLCP_PORT", "native:")
    assert "bank 0 is active" in evlcp("tx", "message", "--text", "hi").out
    monkeypatch.setenv("EVLCP_PORT", "unix:/nowhere")
    assert evlcp("tx", "message", "--text", "hi").code == 4
    # who asks for a file gets that, not lamps that blink
    well(evlcp("tx", "message", "--text", "hi", "-o", tmp_path / "m.json"))


# -- streams


def test_texts_go_out_as_they_come(native, tmp_path):
    leds = tmp_path / "leds.bin"
    command = [*EVLCP, "board", "stream", "--port", native, "--id", "7", "--json"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        # each when the one before has long been played
        for n in (3, 2, 1):
            process.stdin.write(f"Green in {n} s\n")
            process.stdin.flush()
            seen = leds.stat().st_size
            while leds.stat().st_size < seen + 2000 * RECORD.itemsize:
                time.sleep(0.02)
        done = json.loads(process.communicate()[0])
    assert process.returncode == 0
    expected = [messages_of(packet[None])[Kind.TEXT] for packet in packets_on(leds)]
    assert [m.text for m in expected] == ["Green in 3 s", "Green in 2 s", "Green in 1 s"]
    assert [m.transmitter_id for m in expected] == [7, 7, 7]
    assert sorted({m.sequence for m in expected}) == [m.sequence for m in expected], (
        "each with a higher number"
    )
    assert done["packets"] == 3
    assert done["underruns"] in (2, 3)


def test_symbols_from_a_file(evlcp, native, tmp_path):
    table = json.loads(evlcp("tx", "frames", "--random", 4, "--seed", 5, "--format", "json").out)["symbols"]
    file = tmp_path / "lines.jsonl"
    # a packet a line, then two on one
    file.write_text("\n".join(map(json.dumps, (table[0], table[1], table[2:]))) + "\n\n")
    done = evlcp("board", "stream", file, "--lines", "symbols", "--repeat", 2, "--port", native)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("8 packets, ")
    assert packets_on(tmp_path / "leds.bin").tolist() == [packet for packet in table for _ in range(2)]


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (b"hi\n[", ("--lines", "symbols"), "line 1: not JSON"),
        (b"[[1]]", ("--lines", "symbols"), "line 1: symbols[0]: found 1 elements, expected 10 frames"),
        (b"{}", ("--lines", "symbols"), "line 1: symbols: found {}"),
        (b"[" * 100_000, ("--lines", "symbols"), "line 1: not JSON"),
        (b"a" * 70_000, (), "line 1: message: 70000 bytes"),
        (b"\xff", (), "cannot be read"),
    ],
)
def test_a_wrong_line_is_reported(evlcp, tmp_path, text, options, message):
    file = tmp_path / "lines"
    file.write_bytes(text)
    check_fault(evlcp("board", "stream", file, "--port", "native:", *options), 3, message)


def test_what_is_no_field_and_what_does_not_change_is_named(evlcp, tmp_path):
    message = ("tx", "message", "--text", "{foo} {n} {left}")
    once, anew = (evlcp(*message, *more).err for more in (("-o", tmp_path / "m"), ("--every", 5)))
    assert once.startswith("evlcp: --text: {foo}, {n}, {left} sent as it stands; --every")
    assert anew.startswith("evlcp: --text: {foo}, {left} sent as it stands; --every")
    done = evlcp("tx", "message", "--countdown", 9, "--port", "native:")
    assert "the board repeats what holds now; --every SECONDS" in done.err


def test_a_message_that_changes(evlcp, native, tmp_path):
    began = time.time()
    options = ("--text", "{n}: {left} s left at {time}", "--time", "--countdown", 100, "--sequence", 40)
    done = evlcp(
        *("tx", "message", *options, "--signal", "amber", "--next", "red", "--every", 1, "--count", 2),
        *("--port", native, "--json"),
    )
    assert (done.code, done.err) == (0, "")
    packets = packets_on(tmp_path / "leds.bin")
    assert len(packets) == json.loads(done.out)["packets"] >= 20, "round and round for two seconds"
    first, last = (messages_of(some) for some in (packets[:3], packets[-3:]))
    assert [m[Kind.TEXT].sequence for m in (first, last)] == [40, 41]
    for n, found in enumerate((first, last)):
        time_s = TimeKind().unpack(found[Kind.TIME].payload)
        left = CountdownKind().unpack(found[Kind.COUNTDOWN].payload)
        clock = time.strftime("%H:%M:%S", time.gmtime(time_s))
        assert found[Kind.TEXT].text == f"{n}: {left.left_s:.0f} s left at {clock}"
        assert (left.signal, left.next_signal) == ("amber", "red")
        assert began + n <= time_s <= time.time()
        assert began + 99.9 <= time_s + left.left_s <= time.time() + 100.1
