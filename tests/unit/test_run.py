"""The use cases as library functions."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evlcp_sdk
from evlcp_sdk.errors import InputError, InterruptedRunError
from evlcp_sdk.io import DEFAULT_MAX_EVENTS, RawSource, read_events
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.run import convert, receive
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events, Packet, Triggers


def numbers_of(packets: Iterable[Packet]) -> list[tuple[int, int, list[int]]]:
    """(transmitter, packet, frames' numbers) of each."""
    return [(p.transmitter, p.packet, [f.frame for f in p.frames]) for p in packets]


def test_a_recording_that_is_converted_in_part_is_not_written(demo_raw: Path, tmp_path: Path) -> None:
    asked = iter([False, True])
    with pytest.raises(InterruptedRunError, match=r"out\.csv is not written"):
        convert(demo_raw, tmp_path / "out.csv", stopped=lambda: next(asked, True))
    assert list(tmp_path.iterdir()) == []
    # Of a source with a pace of its own, what came until then is the recording.
    asked = iter([False] * 3)
    with RawSource(demo_raw) as source:
        counts = convert(source, tmp_path / "part.raw", stopped=lambda: next(asked, True))["counts"]
    with RawSource(tmp_path / "part.raw") as part:
        assert sum(map(len, part.chunks())) == counts["events"] > 0
    # Of a table that is wrong from its first row on nothing is written over it.
    (tmp_path / "wrong.csv").write_text("t_us,x,y,p\n1,2,3,7\n")
    with pytest.raises(InputError, match="line 2: polarity 7"):
        convert(tmp_path / "wrong.csv", tmp_path / "part.raw", size=(1280, 720))
    assert read_events(tmp_path / "part.raw")


def test_the_last_packet_comes_too_and_the_source_is_closed(demo_raw: Path) -> None:
    closed = []

    class Watched(RawSource):
        def close(self) -> None:
            closed.append(True)
            super().close()

    reception = receive(Watched(demo_raw))
    found = numbers_of(reception)
    # By the plain loop, closed at its end.
    receiver = Receiver(load_link())
    with RawSource(demo_raw) as source:
        packets = [p for events in source.chunks() for p in receiver.feed(events)] + receiver.close()
    assert found == numbers_of(packets)
    assert list(reception) == []
    assert reception.counts["packets"] == len(found)
    assert reception.losses == {}
    assert closed


def test_input_that_fails_gives_what_was_decoded_first(demo_raw: Path) -> None:
    class Failing(RawSource):
        def stream(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[tuple[Events, Triggers]]:
            yield from [next(super().stream(400_000))]
            raise InputError(f"{self.path}: the disk is gone")

    reception, packets = receive(Failing(demo_raw)), []
    with pytest.raises(InputError, match="the disk is gone"):
        packets.extend(reception)
    assert sum(len(packet.frames) for packet in packets) == reception.counts["frames"] > 0


def test_a_simulation_is_a_source_like_a_recording(tmp_path: Path, evlcp: Callable[..., Any]) -> None:
    settings = "duration_s=0.05", "motion.distance_m=70"
    first, source = (evlcp_sdk.simulate("night", seed=4, overrides=settings) for _ in range(2))
    assert repr(first) == "SimulatedSource(night, 1 bar, 0.05 s, seed 4)"
    events, triggers = first.read()
    assert len(triggers) == 0
    assert first.counts["events"] == first.counts["simulated_events"] == len(events)
    written = source.save(tmp_path / "a.raw")
    recorded = read_events(tmp_path / "a.raw")
    for column in ("t_us", "x", "y", "p"):
        assert np.array_equal(getattr(events, column), getattr(recorded, column)), column
    assert written == (tmp_path / "a.raw", tmp_path / "a.truth.json")
    options = [word for setting in settings for word in ("--set", setting)]
    done = evlcp("simulate", "--preset", "night", "--seed", 4, "-o", tmp_path / "b.raw", *options)
    assert done.code == 0
    assert written[0].read_bytes() == (tmp_path / "b.raw").read_bytes()
    assert written[1].read_text() == (tmp_path / "b.truth.json").read_text()
    with pytest.raises(evlcp_sdk.StreamError, match="has been read already"):
        source.save(tmp_path / "c.raw")
    with pytest.raises(evlcp_sdk.ConfigError, match=r"a recording is written as NAME\.raw"):
        evlcp_sdk.simulate("night").save(tmp_path / "c.csv")


def test_a_simulation_sends_the_link_that_it_is_given() -> None:
    link = evlcp_sdk.load_link(overrides=["air.chip_rate_hz=5000.0", "modulation.id=wh8"])
    source = evlcp_sdk.simulate("night", seed=3, link=link, overrides=["duration_s=0.12"])
    (bar,) = source.truth.bars
    assert bar.link.codebook.digest == link.codebook.digest
    assert bar.link.air == link.air
    frames = list(evlcp_sdk.receive(source, link).frames())
    sent = bar.symbols.reshape(-1, 16).tolist()
    assert frames
    assert all(frame.soft.symbols.tolist() in sent for frame in frames)
