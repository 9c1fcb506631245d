"""`evlcp tx message`: what it writes and plays says what it was told to say."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import Native

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind, Message, joined
from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.air.signing import TrustedKey, TrustedKeys
from evlcp_sdk.link.resolve import Link, load_link

SITE = """
[[bar]]
transmitter_id = 7
latitude_deg = 35.156789
longitude_deg = 136.965432
height_m = 52.4
heading_deg = 90.0
tilt_deg = 1.5
"""

Evlcp = Callable[..., Any]


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(SITE)
    return path


def symbols_of(chips: np.ndarray, link: Link) -> np.ndarray:
    """Symbols (packets, frames, clusters) of chips that begin with a packet."""
    words = link.codebook.codewords
    whole = chips[: len(chips) // link.packet.packet_chips * link.packet.packet_chips]
    found = []
    for packet in whole.reshape(-1, link.packet.packet_chips, link.codebook.clusters):
        for frame in range(link.packet.frames):
            begin = link.packet.frame_start_chip(frame)
            begin += link.packet.pilot_chips if link.packet.has_pilot(frame) else 0
            info = packet[begin : begin + link.packet.info_chips].T
            found.append((info[:, None] == words).all(2).argmax(1))
    return np.array(found).reshape(-1, link.packet.frames, link.codebook.clusters)


def messages_of(symbols: np.ndarray, link: Link) -> dict[Kind, Message]:
    """The messages that packets carry, each whole, by kind."""
    coder = link.block_coder()
    parts: dict[Kind, dict[int, Block]] = {}
    for packet in symbols:
        bits = bits_of_symbols(packet, link.codebook.bits_per_symbol)
        content = coder.block((4 - 8.0 * bits).astype(np.float32))
        assert content is not None
        block = Block.unpack(content)
        assert block.codebook == coder.digest
        parts.setdefault(block.kind, {})[block.index] = block
    found = {}
    for kind, blocks in parts.items():
        payload = joined([blocks[i].part for i in range(len(blocks))], blocks[0].length)
        found[kind] = Message(kind, blocks[0].transmitter_id, blocks[0].sequence, payload)
    return found


def test_a_text_a_file_and_a_beacon(evlcp: Evlcp, site: Path, tmp_path: Path) -> None:
    data, out, chips = tmp_path / "data.bin", tmp_path / "m.json", tmp_path / "c.npy"
    data.write_bytes(bytes(range(100)))
    done = evlcp(
        *(
            "tx",
            "message",
            "--text",
            "Tempo 30 für 2 km",
            "--file",
            data,
            "--beacon",
            site,
            "--user",
            "lane 2",
        ),
        *("--sequence", "5", "-o", out, "--chips", chips),
    )
    assert done.code == 0, done.err
    assert done.out.splitlines() == [
        "beacon       34 bytes, transmitter 7, sequence 5",
        "text         18 bytes, transmitter 7, sequence 5",
        "data        100 bytes, transmitter 7, sequence 5",
        f"5 packets, 0.173 s, in {out} and {chips}",
    ]
    link = load_link()
    table = json.loads(out.read_text())
    assert (table["link"]["modulation"]["id"], table["codebook"]) == ("wh4x2", link.codebook.digest)
    found = messages_of(np.array(table["symbols"]), link)
    assert found[Kind.TEXT] == Message(Kind.TEXT, 7, 5, "Tempo 30 für 2 km".encode())
    assert found[Kind.DATA].payload == bytes(range(100))
    beacon = Beacon.unpack(found[Kind.BEACON].payload)
    assert beacon == Beacon(35.156789, 136.965432, 52.4, 90.0, 1.5, 0.96, b"lane 2")
    assert (symbols_of(np.load(chips), link) == table["symbols"]).all()


@pytest.mark.parametrize(
    "settings",
    [
        ("modulation.id=raw8", "air.frames_per_packet=20", "air.pilot_every=4"),
        ("modulation.id=wh8", "error-correction.id=reed-solomon"),
    ],
)
def test_any_link(evlcp: Evlcp, tmp_path: Path, settings: tuple[str, ...]) -> None:
    chips = tmp_path / "c.npy"
    options = [part for setting in settings for part in ("--set", setting)]
    played = evlcp("tx", "message", "--text", "Hello", "--port", "native:", *options)
    assert played.code == 0, played.err
    done = evlcp(
        "tx", "message", "--text", "Hello " * 40, "--chips", chips, "--repeat", 2, "--json", *options
    )
    assert done.code == 0, done.err
    link = load_link(overrides=settings)
    symbols = symbols_of(np.load(chips), link)
    assert (symbols[::2] == symbols[1::2]).all()
    found = messages_of(symbols, link)[Kind.TEXT]
    assert found.text == "Hello " * 40
    told = json.loads(done.out)
    assert told["symbols"] == symbols.tolist()
    assert told["duration_s"] == pytest.approx(len(np.load(chips)) / 1e4)
    # Without a number it is the time, so that a later message has a higher one.
    assert abs(found.sequence - time.time()) < 60


def test_a_signed_beacon(evlcp: Evlcp, site: Path, tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="the extra sign is not installed")
    key, out = tmp_path / "private.pem", tmp_path / "m.json"
    made = evlcp("tx", "keygen", key)
    assert made.code == 0
    assert evlcp("tx", "message", "--beacon", site, "--key", key, "-o", out).code == 0
    link = load_link()
    found = messages_of(np.array(json.loads(out.read_text())["symbols"]), link)
    keys = TrustedKeys([TrustedKey(made.out.strip())])
    assert keys.check(found[Kind.BEACON], link.block_coder().digest, found[Kind.SIGNATURE]) is True
    again = evlcp("tx", "keygen", key)
    assert (again.code, again.err) == (
        1,
        f"evlcp: {key}: exists; a key is not overwritten; --show prints it again\n",
    )


def test_faults_are_one_line(evlcp: Evlcp, site: Path, tmp_path: Path) -> None:
    two = tmp_path / "two.toml"
    two.write_text(SITE + SITE.replace("= 7", "= 8"))
    for options, code, told in (
        ((), 2, "give what to send: --text TEXT, --file FILE, --beacon site.toml, --time or --countdown"),
        (("--text", ""), 2, "message: 0 bytes of text, expected 1 to 65535"),
        (("--text", "a\udcff"), 2, "--text: character 2 is not UTF-8"),
        (("--beacon", two, "--id", "7", "--user", "\udcff"), 2, "--user: character 1 is not UTF-8"),
        (("--text", "a", "--user", "b"), 2, "--key and --user belong to a beacon"),
        (("--file", tmp_path / "no"), 3, "no: cannot be read"),
        (("--beacon", tmp_path / "no"), 2, "no: cannot be read"),
        (("--beacon", two), 2, "2 bars: choose one with --id, of 7, 8"),
        (("--beacon", two, "--id", "9"), 2, "no bar has transmitter_id 9, but 7, 8"),
        (("--text", "a", "--set", "air.frames_per_packet=2"), 2, "expected at least 18"),
        (("--text", "a", "-o", tmp_path), 1, "cannot be written"),
    ):
        done = evlcp("tx", "message", *options)
        assert done.code == code, done.err
        assert told in done.err
        assert done.err.count("\n") == 1
    assert evlcp("tx", "message", "--beacon", two, "--id", 8, "--json").code == 0


def test_what_tx_wrote_tx_shows(evlcp: Evlcp, tmp_path: Path) -> None:
    out, chips, again = tmp_path / "m.json", tmp_path / "c.npy", tmp_path / "again.npy"
    (tmp_path / "link.toml").write_text('[pilots]\nid = "barker13"\n')
    options = ("--set", "pilots.id=barker13")
    assert evlcp("tx", "message", "--text", "hi", "-o", out, "--chips", chips, *options).code == 0
    for named in ((), options, ("-c", tmp_path / "link.toml"), (*options, "--set", "camera.focal_mm=50.0")):
        done = evlcp("tx", "frames", out, "--chips", again, *named)
        assert done.code == 0, done.err
        assert (np.load(again) == np.load(chips)).all()
        again.unlink()
        assert evlcp("tx", "check", out, *named).code == 0
    # a word is the chips, most significant first: the first pilot stands behind the preamble
    word = evlcp("tx", "frames", out, "--format", "json").out
    bits = "".join(str(chip) for chip in np.load(chips)[26:52, 0])
    assert int(json.loads(word)["pilot_words"][0], 16) == int(bits, 2)


@pytest.mark.parametrize(
    ("other", "differ"),
    [
        ("modulation.id=wh8", 'modulation.id: sent with "wh4x2", received with "wh8"'),
        ("pilots.id=wh", 'pilots.id: sent with "barker13", received with "wh"'),
        ("air.chip_rate_hz=5000.0", "air.chip_rate_hz: sent with 10000.0, received with 5000.0"),
        ("error-correction.id=reed-solomon", "error-correction.id: sent with"),
    ],
)
def test_another_link_is_refused_and_says_where(
    evlcp: Evlcp, tmp_path: Path, other: str, differ: str
) -> None:
    out = tmp_path / "m.json"
    assert evlcp("tx", "message", "--text", "hi", "-o", out, "--set", "pilots.id=barker13").code == 0
    for command in (("tx", "frames"), ("tx", "check"), ("board", "--port", "native:", "program")):
        done = evlcp(*command, out, "--set", "pilots.id=barker13", "--set", other)
        assert (done.code, done.out) == (8, "")
        assert done.err.startswith(f"evlcp: {out}: made with another link: ")
        assert differ in done.err
        assert done.err.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (("air.chip_rate_hz=12.5",), "air.chip_rate_hz = 12.5: a board takes whole chips per second"),
        (("air.chip_rate_hz=2e6",), "air.chip_rate_hz = 2000000.0, at most 1000000"),
    ],
)
def test_a_link_that_no_board_can_play_is_one_line(
    evlcp: Evlcp, tmp_path: Path, settings: tuple[str, ...], says: str
) -> None:
    options = [part for setting in settings for part in ("--set", setting)]
    for command in (
        ("tx", "message", "--text", "hi", "--repeat", 2, "--port", "native:"),
        ("board", "--port", "native:", "program", "--random", 1),
        ("board", "--port", "native:", "verify", "--masks", tmp_path / "no.npy"),
    ):
        done = evlcp(*command, *options)
        assert done.code == 2, done.err
        assert done.err.startswith("evlcp: the driver board cannot play this link: ")
        assert says in done.err
        assert done.err.count("\n") == 1


def test_without_an_output_nothing_is_said_to_be_sent(evlcp: Evlcp, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EVLCP_PORT", raising=False)
    done = evlcp("tx", "message", "--text", "hi")
    assert done.code == 2
    assert done.out.splitlines()[-1] == "1 packet, 0.0346 s"
    wanted = "evlcp: nothing is sent or written: give --port (or EVLCP_PORT), -o or --chips\n"
    assert done.err == wanted
    assert evlcp("tx", "message", "--text", "hi", "--json").code == 0


@pytest.mark.usefixtures("compiler")
def test_the_port_may_come_from_the_environment(
    evlcp: Evlcp, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("EVLCP_PORT", "native:")
    assert "bank 0 is active" in evlcp("tx", "message", "--text", "hi").out
    monkeypatch.setenv("EVLCP_PORT", "unix:/nowhere")
    assert evlcp("tx", "message", "--text", "hi").code == 4
    # who asks for a file gets that, not lamps that blink
    assert evlcp("tx", "message", "--text", "hi", "-o", tmp_path / "m.json").code == 0


@pytest.mark.usefixtures("compiler")
def test_a_board_plays_it(evlcp: Evlcp, site: Path, tmp_path: Path) -> None:
    port, leds, chips = f"unix:{tmp_path / 'board'}", tmp_path / "leds.bin", tmp_path / "c.npy"
    emulated = Native(port, leds=leds)
    done = evlcp(
        "tx", "message", "--text", "Tempo 30 " * 20, "--beacon", site, "--sequence", 3, "--port", port
    )
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == "sent 1920 of 1920 bytes; bank 0 is active"
    assert done.out.splitlines()[-2].endswith(", again and again")
    # More packets than a bank holds are refused, and what plays goes on.
    (tmp_path / "big").write_bytes(bytes(60_000))
    refused = evlcp("tx", "message", "--file", tmp_path / "big", "--port", port)
    assert refused.code == 2
    assert "packets of 320 bytes, a bank of" in refused.err
    time.sleep(0.5)
    assert evlcp("board", "stop", "--port", port).code == 0
    emulated.end()
    assert evlcp("board", "leds", leds, "--chips", chips).code == 0
    link = load_link()
    found = messages_of(symbols_of(np.load(chips), link), link)
    assert found[Kind.TEXT].text == "Tempo 30 " * 20
    assert Beacon.unpack(found[Kind.BEACON].payload).height_m == 52.4
