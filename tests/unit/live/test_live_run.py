"""A live run gives what a run over the file gives, and leaves out what it has no time for, counted."""

import dataclasses
import json
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.cli._summary import print_summary
from evlcp_sdk.cli.live import format_status
from evlcp_sdk.errors import InputError
from evlcp_sdk.io import RawSource, ReplaySource, open_source, write_events
from evlcp_sdk.link.compose import compose
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.live import Budget, LiveStatus, Publisher, Subscription
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.run import live, receive
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.recordings import IdealBar, ideal_events
from evlcp_sdk.utc import PulseClock
from evlcp_sdk.values import Events, Packet, Triggers
from tests.unit.live.helpers import PATIENT, dies, key, sender

SHARED = Path(__file__).parents[4] / "shared" / "recordings"


def gather(subscription: Subscription) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for news in subscription.take():
        found.setdefault(news.kind, []).append(news.value)
    assert subscription.dropped == 0
    return found


def test_a_replay_gives_what_the_file_gives(demo_raw, tmp_path, capsys) -> None:
    publisher = Publisher()
    publisher.pictures.request()
    mine = publisher.subscribe(most=100_000)
    given: dict[str, Any] = {"publisher": publisher, "budget": PATIENT, "warm": False}
    summary = live(f"replay:{demo_raw}?speed=50", tmp_path / "out", **given)
    found = gather(mine)
    packets = list(receive(demo_raw))
    assert [key(f) for f in found["frame"]] == [key(f) for packet in packets for f in packet.frames]
    assert [key(p.frames[0]) for p in found["packet"]] == [key(p.frames[0]) for p in packets]
    with RawSource(demo_raw) as source:
        events, _ = source.read()
    assert (Events.concat(found["events"]).t_us == events.t_us).all()
    last: LiveStatus = found["status"][-1]
    assert (last.events, last.level, sum(last.shed.values())) == (len(events), 0, 0)
    assert found["end"] == [summary]
    assert summary["status"] == "complete"
    assert summary["live"]["delays"]["total"]["count"] > 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["live"] == summary["live"]
    assert publisher.pictures.newest is not None
    text = format_status(last)
    assert text.startswith(f"{last.elapsed_s:.0f} s, ")
    assert f", {last.counts['frames']} frames" in text
    shed = format_status(dataclasses.replace(last, level=2))
    assert shed == f"{text}; rows outside of regions are shed, and distances of most frames"
    print_summary(summary, None)
    total = summary["live"]["delays"]["total"]
    message = f"delay of {total['count']} frames, from the last chip: p50 {total['p50_ms']:.1f}, p99"
    assert message in capsys.readouterr().out


def test_frames_of_several_links_name_theirs(demo_raw: Path) -> None:
    links = [load_link(), load_link(overrides=["modulation.id=wh8"])]
    publisher = Publisher()
    mine = publisher.subscribe({"frame", "packet"}, most=100_000)
    live(f"replay:{demo_raw}?speed=50", None, links, publisher=publisher, budget=PATIENT, warm=False)
    found = gather(mine)
    packets = list(receive(demo_raw, links))
    assert [key(f) for f in found["frame"]] == [key(f) for packet in packets for f in packet.frames]
    assert {frame.link for frame in found["frame"]} == {packet.link for packet in packets} == {"link-0"}


def test_pulses_of_a_recording_say_what_utc_it_is(tmp_path: Path, evlcp: Callable[..., Any]) -> None:
    """A clock 25 ppm too fast, with a stray edge; the falling edges are none."""
    pulses = 200_000 + np.arange(4) * 1_000_025
    t_us = np.sort(np.concatenate([pulses, pulses + 50_000, [1_700_000]]))
    triggers = Triggers.of(t_us, np.zeros(9, int), ~np.isin(t_us, pulses + 50_000))
    few = np.arange(100, 3_400_000, 500)
    events = Events.of(few, np.full(len(few), 3), np.full(len(few), 4), np.arange(len(few)) % 2)
    write_events(tmp_path / "pps.raw", events, 1280, 720, triggers)
    given = ("--pps", "0", "--clock-zero", "2026-03-01T12:00:00Z", "--waiting-ms", "100000", "--json")
    done = evlcp("live", f"replay:{tmp_path / 'pps.raw'}?speed=20", *given)
    assert done.code == 0, done.err
    counted = {"pulses": 4, "pulses_rejected": 1, "rate_ppm": 25.0, "channel": 0, "others": []}
    assert json.loads(done.out)["pps"] == counted
    done = evlcp("receive", tmp_path / "pps.raw", "-o", tmp_path / "out", "--pps", "9", *given[2:4])
    assert done.code == 0, done.err
    message = " ".join((done.out + done.err).split())
    assert "no pulse of UTC came on channel 9 of the trigger input; on others something came: 0" in message
    done = evlcp("receive", tmp_path / "pps.raw", "-o", tmp_path / "out", "--pps", "0")
    assert done.code == 2
    assert "a pulse says when a second of UTC begins, not which one: give --clock-zero" in done.err
    clock = PulseClock(0, datetime(2026, 3, 1, 12, tzinfo=UTC))
    assert list(receive(tmp_path / "pps.raw", clock_zero=clock)) == []
    assert clock.to_dict() == counted


def test_a_time_that_is_sent_says_the_delay_from_end_to_end(tmp_path: Path) -> None:
    """It says a time 2 ms before its first chip shines, as a transmitter whose clock is slow."""
    link, said_s, start_us = load_link(), 1_800_000_000, 6_000.0
    symbols = compose(link, other={"time": float(said_s)}, repeat=3, sequence=1)
    write_events(tmp_path / "time.raw", ideal_events(link, IdealBar(symbols, start_us=start_us)), 1280, 720)
    zero = datetime.fromtimestamp(said_s, UTC) + timedelta(milliseconds=2, microseconds=-start_us)
    publisher, told_s = Publisher(), []
    mine = publisher.subscribe({"message"}, wake=lambda: told_s.append(time.monotonic()))
    source = ReplaySource(open_source(tmp_path / "time.raw"))
    summary = live(source, None, link, clock_zero=zero, publisher=publisher, budget=PATIENT, warm=False)
    (news,) = mine.take()
    assert news.value.age_s == pytest.approx(2e-3, abs=5e-5)
    assert summary["live"]["delays"]["end_to_end"]["max_ms"] == round(news.late_ms, 3)
    shone_s = source.clock_s(news.t_us)
    assert shone_s is not None
    # All of the packet has to be seen first; it is told at once when it is read.
    assert 2.0 + 34.6 < news.late_ms <= 2.05 + (told_s[0] - shone_s) * 1e3
    # Without UTC, a replay says nothing of it.
    summary = live(f"replay:{tmp_path / 'time.raw'}?speed=50", None, link, budget=PATIENT, warm=False)
    assert summary["counts"]["messages"] == 1
    assert summary["live"]["delays"]["end_to_end"]["count"] == 0


class Burst(EventSource):
    """A recording all at once, as from a camera that a stalled program comes back to."""

    live = True

    def __init__(self, path: Path) -> None:
        self._source = RawSource(path)
        super().__init__(path, "X", self._source.width, self._source.height)

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        return next(self._source.stream(2000), None)

    def close(self) -> None:
        self._source.close()


def test_what_there_is_no_time_for_is_left_out_and_counted(demo_raw: Path) -> None:
    publisher = Publisher()
    mine = publisher.subscribe({"events", "status"}, most=100_000)
    summary = live(
        Burst(demo_raw), publisher=publisher, budget=Budget(waiting_ms=0.1, most_ms=0.4), warm=False
    )
    with RawSource(demo_raw) as source:
        total = len(source.read()[0])
    assert sum(len(events) for events in gather(mine)["events"]) == total
    shed = summary["live"]["shed"]
    assert shed["too_late"] > 0
    left_out = sum(n for name, n in shed.items() if name != "frames_not_ranged")
    assert summary["counts"]["events"] + left_out == total


def test_slices_that_wait_are_taken_together_and_nothing_is_left_out(demo_raw: Path, monkeypatch) -> None:
    taken, feed = [], Receiver.feed

    def counted(self: Receiver, events: Events) -> list[Packet]:
        taken.append(len(events))
        return feed(self, events)

    monkeypatch.setattr(Receiver, "feed", counted)
    mine = (publisher := Publisher()).subscribe({"frame"}, most=100_000)
    live(Burst(demo_raw), publisher=publisher, budget=PATIENT, warm=False)
    # A slice has 2000 events.
    assert max(taken) > 4000
    assert [key(f) for f in gather(mine)["frame"]] == [key(f) for p in receive(demo_raw) for f in p.frames]


def test_distances_are_measured_of_every_nth_frame(demo_raw: Path) -> None:
    frames = []
    for every in (1, 3):
        reception = receive(demo_raw)
        reception.receiver.ranging_every = every
        frames.append([frame for packet in reception for frame in packet.frames if frame.points_px.size])
        assert reception.counts["frames_not_ranged"] == len(frames[-1]) - len(frames[-1]) // every
    measured = [[not np.isnan(frame.range.distance_m) for frame in some] for some in frames]
    assert all(measured[0])
    assert measured[1] == [n % 3 == 2 for n in range(len(frames[1]))]
    assert [f.soft.symbols.tolist() for f in frames[0]] == [f.soft.symbols.tolist() for f in frames[1]]


def test_it_ends_when_it_is_asked_to(demo_raw: Path) -> None:
    asked = threading.Event()
    publisher = Publisher()
    publisher.subscribe({"frame"}, wake=asked.set)
    summary = live(
        f"replay:{demo_raw}?loop=1", publisher=publisher, budget=PATIENT, warm=False, stopped=asked.is_set
    )
    assert summary["status"] == "interrupted"
    assert summary["counts"]["frames"] > 0


def test_a_damaged_recording_is_not_waited_for(demo_raw: Path, tmp_path: Path) -> None:
    data = bytearray(demo_raw.read_bytes())
    noise, middle = np.random.default_rng(1), len(data) // 2
    data[middle : middle + 20_000] = noise.bytes(20_000)
    damaged = tmp_path / "damaged.raw"
    damaged.write_bytes(data)
    with RawSource(damaged) as source:
        t_us = source.read()[0].t_us
    assert t_us[-1] - t_us[0] > 60e6  # Its clock leaps by minutes.
    mine = (publisher := Publisher()).subscribe(most=100_000)
    summary = live(damaged, publisher=publisher, budget=PATIENT, warm=False)
    waited_us = t_us[-1] - t_us[0] - summary["recording"]["counts"]["silences_skipped_us"]
    assert 0 < waited_us < 10e6
    assert "pace" in [note["code"] for note in summary["notes"]]
    assert [key(f) for f in gather(mine)["frame"]] == [key(f) for p in receive(damaged) for f in p.frames]


def test_who_sends_may_die_at_any_moment(demo_raw: Path, tmp_path: Path, evlcp: Callable[..., Any]) -> None:
    """Half a recording, and half a word, are received; where the connection broke is said in one line."""
    data = demo_raw.read_bytes()
    data = data[: len(data) // 2 | 1]
    (tmp_path / "half.raw").write_bytes(data)
    assert evlcp("receive", tmp_path / "half.raw", "-o", tmp_path / "file").code == 0
    want = (tmp_path / "file" / "frames.csv").read_text()
    assert want.count("\n") > 4
    for end, status, code in ((socket.socket.close, "complete", 0), (dies, "failed", 3)):
        with sender([data], end) as url:
            done = evlcp("live", url, "--waiting-ms", "100000", "--json", "-o", tmp_path / status)
        summary = json.loads(done.out)
        assert (done.code, summary["status"]) == (code, status), done.err
        assert summary["counts"]["frames"] == want.count("\n") - 1
        assert (tmp_path / status / "frames.csv").read_text() == want
    assert re.fullmatch(rf"evlcp: {url}: .*\n", done.err)


def test_the_command(evlcp: Callable[..., Any], demo_raw: Path) -> None:
    run = evlcp("live", f"replay:{demo_raw}?speed=20", "--json-lines", "-", "--waiting-ms", "100000")
    assert run.code == 0
    *lines, summary = [json.loads(line) for line in run.out.splitlines()]
    assert "frame" in {line["line"] for line in lines}
    assert summary["line"] == "summary"
    assert summary["transmitters"]
    assert set(summary["live"]) == {"delays", "shed", "levels_s", "health", "unplugged"}


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("replay:{}?speed=0", "speed = '0': expected a number above 0"),
        ("replay:{}?sped=2", "option 'sped'; did you mean 'speed'?"),
        ("replay:{}?loop=2", "loop = '2': expected 0 or 1"),
        ("replay:{}?for_s=2", "for_s = 2: only with loop=1"),
        ("replay:replay:{}", "has a pace of its own"),
        ("replay:", "expected replay:REC"),
    ],
)
def test_what_is_wrong_with_a_replay_is_reported(url: str, message: str, demo_raw: Path) -> None:
    with pytest.raises(InputError) as fault:
        open_source(url.format(demo_raw))
    assert message in str(fault.value)


def test_what_the_page_is_asked_for_needs_a_page(evlcp: Callable[..., Any], demo_raw: Path) -> None:
    for given in (["--view-record"], ["--view-port", "8080"], ["--view-host", "0.0.0.0"]):
        done = evlcp("live", f"replay:{demo_raw}", *given)
        assert done.code == 2
        assert f"Invalid value for {given[0]}: needs --view" in done.err


_WARMED = """
import sys
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.live.warm import load_kernels
from evlcp_sdk.place.navigator import Navigator, PositionPlan
from evlcp_sdk.run import live
from tests.unit.results.test_positions import ATTITUDE, SITE, packets

def loaded():
    kernels = [m for name, m in sys.modules.items() if name.endswith("_kernels")]
    return {f"{m.__name__}.{name}": len(k.overloads) for m in kernels for name, k in vars(m).items()
            if hasattr(k, "overloads")}

link = load_link()
load_kernels([link], positions=True)
before, modules = loaded(), set(sys.modules)
live(sys.argv[1], None, link, warm=False)
navigator = Navigator(link, PositionPlan((SITE,)), ATTITUDE)
assert [placed for placed in navigator.feed(packets(5)) if not placed.fix.refusal]
navigator.close()
print(sorted(name for name, many in loaded().items() if many != before.get(name, 0)))
print(sorted(name for name in set(sys.modules) - modules if name.startswith("scipy")))
"""


def test_all_that_is_needed_is_loaded_before_the_first_event() -> None:
    """A kernel that is compiled while events come costs seconds of them, SciPy for positions a tenth."""
    recording = SHARED / "two-bars-60m-75m.raw"
    if not recording.exists():
        pytest.skip("needs ../shared")
    given = [sys.executable, "-c", _WARMED, f"replay:{recording}"]
    root = Path(__file__).parents[3]
    found = subprocess.run(given, capture_output=True, text=True, check=True, cwd=root)
    assert found.stdout.split() == ["[]", "[]"]
