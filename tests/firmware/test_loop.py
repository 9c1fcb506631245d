"""A text from end to end: what the steps say and leave is what other readers find in their files."""

import json

import numpy as np
import pytest
from board_lines import LINK, well

from firmware_host.board.bank import symbol_chips
from firmware_host.emulators import simulated
from firmware_host.emulators.led_record import LedRecord
from firmware_host.loop import _describe_frames


def test_a_text_arrives_and_every_file_is_what_others_read(evlcp, tmp_path):
    out = tmp_path / "out"
    done = well(
        evlcp("loop", "--text", "Grüße [b]", "--distance", "80", "--seed", "3", "--report", "-o", out)
    )
    assert "warning" not in done.out
    assert "received/report.html" in done.out
    assert (out / "received" / "report.html").is_file()
    lines = dict(line.split(maxsplit=1) for line in done.out.splitlines() if not line.startswith(" "))
    assert list(lines)[1:] == ["message", "board", "light", "scene", "receiver", "text", "written:"]
    assert lines["message"].startswith('"Grüße [b]", 11 bytes: 1 packet with')
    assert lines["text"].startswith('"Grüße [b]", read from ')
    frames, rest = lines["receiver"].split(" frames, ")
    found, sent = map(int, frames.split(" of "))
    assert sent - 1 <= found <= sent
    assert rest.startswith("0 of ")
    assert float(rest.split("distance ")[1].split(" m")[0]) == pytest.approx(80, abs=0.1)

    result = json.loads((out / "message.json").read_text())["symbols"]
    expected = symbol_chips(np.array(result), LINK)
    played = LedRecord.read(out / "leds.bin")
    assert (np.diff(played.ticks) == 1000).all()
    chips = np.load(out / "chips.npy")
    assert (played.chips() == chips).all()
    assert (chips == np.resize(expected, chips.shape)).all()

    scored = json.loads(evlcp("score", out / "received", out / "loop.truth.json", "--json").out)
    (bar,) = scored["bars"]
    assert (bar["frames_found"], bar["bit_errors"]) == (found, 0)
    well(evlcp("board", "--replay", out / "wire.jsonl", "program", out / "message.json"))
    assert evlcp("config", "-c", out / "link.toml", "--digest").out == evlcp("config", "--digest").out


def test_a_text_that_does_not_arrive_ends_with_1(evlcp, tmp_path):
    done = evlcp("loop", "--distance", "900", "--set", "bar.rows=48", "--json", "-o", tmp_path)
    assert done.code == 1
    steps = [json.loads(line) for line in done.out.splitlines()]
    assert [step["step"] for step in steps] == ["message", "board", "light", "scene", "receiver", "text"]
    assert steps[2]["leds"] == 48
    assert steps[-1]["as_sent"] is False
    assert steps[-1]["texts"] == []
    for step in steps:
        assert all((tmp_path / name).is_file() for name in step["files"])


def test_messages_that_are_not_read_are_refused(evlcp, tmp_path):
    done = evlcp("loop", "--set", "messages.decode=false", "-o", tmp_path)
    assert (done.code, list(tmp_path.iterdir())) == (2, [])
    assert done.err.startswith("evlcp: messages.decode = false: expected true")


def test_without_a_compiler(evlcp, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    simulated._library.cache_clear()  # of tests before, which had one
    done = evlcp("loop", "-o", tmp_path / "out")
    assert done.code == 1
    assert done.err == "evlcp: cc is missing: apt-get install --no-install-recommends gcc libc6-dev make\n"


def test_wrong_bits_are_reported_of_a_light_without_a_distance_too():
    step = {"result": "1 transmitter", "frames": 9, "frames_sent": 10, "bits": 72, "bit_errors": 36}
    message = "9 of 10 frames, 36 of 72 bits wrong (BER 0.5)"
    assert _describe_frames(step | {"distance_m": None}) == message
