"""Kinds of messages: one file and one hook, from compose to packets.jsonl."""

import json
import pickle
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from evlcp_sdk.air.blocks import BlockError, Kind, Message
from evlcp_sdk.air.kinds import BUILT_IN_KINDS, Countdown, CountdownKind, TimeKind
from evlcp_sdk.errors import ConfigError, PluginWarning
from evlcp_sdk.link.compose import compose, encode_messages
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.records import find_message_kinds
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.run import receive, receive_to_folder
from evlcp_sdk.sim import load_scene
from evlcp_sdk.simulated import simulate
from tests.unit.link import wind

REGISTRY = Registry.load(wind)
LINK = load_link(registry=REGISTRY)


def test_a_kind_is_one_file_and_one_hook(tmp_path: Path) -> None:
    """What it does not understand is counted, as are its blocks where it is not installed."""
    symbols = compose(LINK, text="Tempo 30", other={"wind": (7.5, 270.0)}, transmitter_id=3, sequence=9)
    symbols = np.concatenate([symbols, encode_messages([Message(15, 3, 10, b"abc")], LINK.block_coder())])
    scene = load_scene("drive-30kmh", {"duration_s": 0.16, "bars.start_chip": 1300.0})
    (bar,) = scene.bars
    sent = tuple(tuple(tuple(frame) for frame in packet) for packet in symbols.tolist())
    scene = replace(scene, bars=(replace(bar, symbols=sent),))
    raw, _ = simulate(scene).save(tmp_path / "wind.raw")
    summary = receive_to_folder(raw, tmp_path / "out", LINK, registry=REGISTRY)
    lines = [json.loads(line) for line in (tmp_path / "out" / "packets.jsonl").read_text().splitlines()]
    found = {line["kind"]: line for line in lines if line["kind"] != "packet"}
    assert found.keys() == {"text", "wind"}
    assert (found["wind"]["speed_m_s"], found["wind"]["from_deg"]) == (7.5, 270.0)
    assert (found["wind"]["transmitter_id"], found["wind"]["sequence"]) == (3, 9)
    assert (found["wind"]["trust"], found["wind"]["reason"]) == ("unverified", "not signed")
    assert (summary["counts"]["messages"], summary["counts"]["messages_undecodable"]) == (2, 1)
    with receive(raw) as reception:
        (text,) = (message for packet in reception for message in packet.messages)
        assert text.value == "Tempo 30"
        assert reception.counts["blocks_malformed"] >= 2


def test_the_kinds_go_with_the_link() -> None:
    assert LINK.kinds.keys() == {1, 2, 3, 4, 5, 6, 15}
    assert pickle.loads(pickle.dumps(LINK)).kinds[15].name == "wind"
    assert LINK.with_air(pilot_every=2).kinds is LINK.kinds
    with pytest.raises(ConfigError, match=r"^air\.pilot_every = 0: expected greater than 0$"):
        LINK.with_air(pilot_every=0)
    assert LINK.digest == load_link().digest
    for number, kind in BUILT_IN_KINDS.items():
        assert (kind.number, kind.name) == (number, Kind(number).name.lower())


def test_a_time_and_a_countdown() -> None:
    """Bytes as docs/messages.md has them, and what they cannot say."""
    now = datetime(2026, 11, 22, 8, 56, 16, 123456, UTC)
    payload = TimeKind().pack(now.timestamp())
    assert payload == (1795337776123456).to_bytes(8, "little")
    assert TimeKind().unpack(payload) == pytest.approx(now.timestamp(), abs=1e-6)
    assert TimeKind().to_dict(now.timestamp())["time"] == "2026-11-22T08:56:16.123+00:00"
    reported = Countdown("red", "green", 12.3)
    payload = CountdownKind().pack(reported)
    assert payload == bytes([1, 4]) + (12_300).to_bytes(4, "little")
    assert CountdownKind().unpack(payload) == reported
    assert CountdownKind().to_dict(reported) == {"signal": "red", "next_signal": "green", "left_s": 12.3}
    for value in (-1.0, float("nan"), float("inf"), 3e11):
        with pytest.raises(ConfigError, match=r"time: .* s, expected seconds since 1970"):
            TimeKind().pack(value)
    for wrong, expected in (
        (Countdown("blue", "red", 1.0), r"signal = 'blue', expected one of dark, red"),
        (Countdown("red", "red", -0.1), r"expected 0 to 86400"),
        (Countdown("red", "red", float("nan")), r"expected 0 to 86400"),
    ):
        with pytest.raises(ConfigError, match=expected):
            CountdownKind().pack(wrong)
    for kind, data in ((TimeKind(), bytes(7)), (TimeKind(), b"\xff" * 8), (CountdownKind(), bytes(5))):
        with pytest.raises(BlockError):
            kind.unpack(data)
    with pytest.raises(BlockError, match="signal 6, expected 0 to 5"):
        CountdownKind().unpack(bytes([1, 6, 0, 0, 0, 0]))


def bring(number: int, name: str) -> object:
    """A plugin with a kind of messages."""
    kind = type("Other", (wind.Wind,), {"number": number, "name": name})()
    return SimpleNamespace(evlcp_message_kinds=hookimpl(lambda: iter((kind,))))


@pytest.mark.parametrize(
    ("numbers", "name", "fault"),
    [
        ((9, 9), "here", "number 9 or its name is that of"),
        ((16,), "here", "number = 16, expected 7 to 15"),
        ((9,), "packet", "choose another"),
    ],
)
def test_a_kind_without_a_number_or_name_of_its_own_is_left_out(numbers, name, fault) -> None:
    registry = Registry.load(*(bring(number, name) for number in numbers))
    with pytest.warns(PluginWarning, match=fault):
        assert len(find_message_kinds(registry)) == 5 + len(numbers)
    assert len(registry.broken) == 1
