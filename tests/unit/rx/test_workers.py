"""Bars that other processes decode: the same results, and an end that names the process."""

import multiprocessing
import os
import signal
from dataclasses import dataclass, replace

import pytest
from rx_streams import LINK, frame_content, frames_of, lit, noise_events, receive_cut

from evlcp_sdk.errors import ConfigError, InputError, PluginError, WorkerError
from evlcp_sdk.files import find_shipped_file
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.run import receive
from evlcp_sdk.rx import workers
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.recordings import merge_events

_, OWN = lit(3, ppm=50, shake_px=6, shake_hz=12)
_, OTHER = lit(3, 1, x_px=900.7, y_px=300.2, start_us=19_350)
EVENTS = merge_events(OWN, OTHER, noise_events(20_000, 120_000))


@dataclass(frozen=True)
class Broken:
    """A ranging that measures nothing but fails."""

    def compile(self, *_given):
        return fail


def fail(view):
    raise ZeroDivisionError("boom")


def test_the_same_whoever_decodes(monkeypatch):
    """Frames, counts and order, of two links, where memory for events is short."""
    links = [LINK, replace(load_link(overrides=["modulation.id=wh8"]), name="wh8")]
    monkeypatch.setattr(workers, "_MEMORY_BYTES", 1 << 20)
    for link in (LINK, links):
        outcomes = []
        for many in (1, 3):
            reports = []
            receiver, packets = receive_cut(link, EVENTS, (40_000,), on_frame=reports.append, workers=many)
            frames = [(p.t_us, p.link, p.echo_of, [frame_content(f) for f in p.frames]) for p in packets]
            outcomes.append((frames, receiver.counts, sorted(frame_content(f)[1:] for f in reports)))
        assert outcomes[0] == outcomes[1]
        assert len(frames_of(packets)) >= 50
    assert not any(child.name in ("worker 1", "worker 2") for child in multiprocessing.active_children())


@pytest.mark.parametrize("begun", [40_000, 1_500_000])
@pytest.mark.parametrize(
    ("sent", "message"),
    [(signal.SIGKILL, "ended by SIGKILL"), (signal.SIGSTOP, "did not answer for 0.5 s, and was ended")],
)
def test_a_worker_that_ends_or_stalls_is_named(monkeypatch, sent, message, begun):
    """Before it has a bar, and among frames."""
    monkeypatch.setattr(workers, "_STALL_S", 0.5)
    receiver = Receiver(LINK, workers=2)
    (child,) = multiprocessing.active_children()
    receiver.feed(EVENTS[:begun])
    assert child.pid is not None
    os.kill(child.pid, sent)
    with pytest.raises(WorkerError, match=f"^worker 1 of the receiver, process {child.pid}, {message}"):
        receiver.feed(EVENTS[begun:])
    child.join(10)
    assert child.exitcode == -signal.SIGKILL


def test_what_fails_in_a_worker_is_named():
    """As it is where it runs here."""
    broken = LINK.with_algorithm("ranging", Broken(), id="broken")
    for many in (1, 2):
        with pytest.raises(PluginError, match=r"^ranging algorithm .broken.: ZeroDivisionError: boom"):
            receive_cut(broken, EVENTS, workers=many)


def test_who_stops_reading_ends_the_workers_and_closes_the_source():
    before = multiprocessing.active_children()
    with receive(find_shipped_file("recordings", "night-50m-30kmh-cut.raw"), workers=2) as packets:
        next(packets)
    assert set(multiprocessing.active_children()) <= set(before)
    assert list(packets) == []
    with pytest.raises(InputError, match="closed file"):
        list(packets.source.chunks())


def test_what_cannot_be():
    with pytest.raises(ConfigError, match=r"^workers: 0, expected 1 or more"):
        Receiver(LINK, workers=0)

    class Listens:
        @hookimpl
        def evlcp_stage_finished(self): ...

    with pytest.raises(ConfigError, match=r"^2 processes, expected 1 \(--cores, workers\): a sink or"):
        Receiver(LINK, Registry.load(Listens()).hook, workers=2)
    local = LINK.with_algorithm("ranging", type("Local", (Broken,), {})(), id="local")
    with pytest.raises(ConfigError, match=r"^workers: an algorithm cannot be sent to another process"):
        Receiver(local, workers=2)
    one_cluster = "bar.rows=6 bar.columns=1 bar.cluster_rows=6 bar.cluster_columns=1"
    lamp = load_link(overrides=[*one_cluster.split(), "framing.id=uart"])
    before = multiprocessing.active_children()
    Receiver(lamp, workers=2)
    assert multiprocessing.active_children() == before, "a lamp's characters are not shared"
    spots = replace(load_link(overrides=["detection.id=spots", "modulation.id=wh8"]), name="spots")
    Receiver([LINK, spots], workers=2).close()
