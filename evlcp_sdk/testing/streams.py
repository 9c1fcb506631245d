"""Laws of algorithms with a state: detection, framing, synchronization, tracking."""

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.testing.exercises import (
    FRAME_US,
    compile_subject,
    feed_events,
    filters_of,
    link_of,
    make_recording,
    run_filter,
    single_cluster_link,
)
from evlcp_sdk.testing.law import Subject, expect, expect_same, law
from evlcp_sdk.testing.recordings import bar_in_sight, ideal_events, random_symbols
from evlcp_sdk.values import Events, SyncLock

_PACKETS = 4
_STEP_US = 1500
_FLUSH_US = 100_000
_RATE_CHIPS = 0.02
"""Most error of the clock rate over a packet, chips: a fiftieth moves no edge, and is 58 ppm of the default
packet's 346 chips. With few pixels and short packets the scatter of events leaves up to half of it."""
_SAME = 1e-9
"""Relative tolerance: 0.1 ns in the times of these recordings."""
_TOLERANCE_CHIPS = 0.75
_MAX_BYTES = 1 << 22
"""Most bytes of a pickled state, however long the stream is."""
_RESULTS = {"framing": "frames", "synchronization": "locks", "detection": "regions"}
"""Names of the results of a role."""


@dataclass(frozen=True)
class _Machine:
    """A synchronizer or a detector with the interface of a deframer."""

    init: Callable[[], Any]
    step: Callable[[Any, Events, int], Any]

    def close(self, state: Any) -> Any:
        return state, []

    def counts(self, state: Any) -> dict[str, int]:
        return {}


def _compile_machine(subject: Subject) -> tuple[Link, Any]:
    """Return the link, and the deframer of its events to frames, locks, or the regions of each step."""
    link, made = link_of(subject), compile_subject(subject)
    if subject.role == "synchronization":
        return link, _Machine(made.init, lambda s, events, until: made.step(s, events.t_us, events.p, until))
    if subject.role == "detection":

        def detect(state: Any, events: Events, until_us: int) -> Any:
            state, regions = made.step(state, until_us - _STEP_US, events)
            return state, [regions]

        return link, _Machine(made.init, detect)
    return link, made


def _make_recording(subject: Subject, link: Link) -> Events:
    return make_recording(link, _PACKETS, missing=0.1 if subject.role == "synchronization" else 0.0)[1]


def _step_times(events: Events) -> list[int]:
    last = int(events.t_us[-1]) + 1
    end = -(-(last + _FLUSH_US) // _STEP_US) * _STEP_US
    return [*range(_STEP_US, last + _STEP_US, _STEP_US), end]


def _check_any_split(subject: Subject) -> None:
    link, machine = _compile_machine(subject)
    kind, events = _RESULTS[subject.role], _make_recording(subject, link)
    wanted = feed_events(machine, events, _step_times(events))
    last = int(events.t_us[-1]) + 1
    rng = np.random.default_rng(0)
    cuts = {
        "all at once": [],
        "at random": np.sort(rng.integers(1, last, 200)).tolist(),
        "every 437 us": range(437, last, 437),
    }
    for how, until_us in cuts.items():
        got = feed_events(machine, events, [*until_us, last + _FLUSH_US])
        expect_same(got, wanted, f"the same {kind} from events fed {how} as every 1500 us", _SAME, kind)


@law("state-kept", "a step leaves the state it is given, which can be pickled")
def _check_state_kept(subject: Subject) -> None:
    link, machine = _compile_machine(subject)
    kind, events = _RESULTS[subject.role], _make_recording(subject, link)

    def branch(state: Any, piece: Events, until_us: int) -> Any:
        # A branch that is given up, and a pickled state.
        then, _ = machine.step(state, piece, until_us)
        counts = machine.counts(then)
        expect(all(isinstance(n, int) for n in counts.values()), f"counts of whole numbers, got {counts}")
        return pickle.loads(pickle.dumps(state))

    got, wanted = (feed_events(machine, events, _step_times(events), keep) for keep in (branch, None))
    expect_same(got, wanted, f"branches and pickling not to change the state: the same {kind}", name=kind)


@law("clean", "no error in the events of an ideal sensor, every frame in its place")
def _check_clean(subject: Subject) -> None:
    link, deframer = _compile_machine(subject)
    bar, events = make_recording(link, _PACKETS, missing=0.0)
    found = feed_events(deframer, events, _step_times(events))
    sent = bar.symbols.reshape(-1, link.codebook.clusters)
    # The first packet starts with the recording, so that its first frame may be cut.
    expect(len(found) >= len(sent) - 1, f"{len(sent)} frames, or all but the first; got {len(found)}")
    starts = np.array(link.packet.frame_starts[:-1])
    for one in found:
        at = (one.t_us - bar.start_us) / link.packet.chip_us
        packet, chip = divmod(at + _TOLERANCE_CHIPS, link.packet.packet_chips)
        chip -= _TOLERANCE_CHIPS
        frame = int(np.abs(starts - chip).argmin())
        off = abs(chip - starts[frame])
        expect(off <= _TOLERANCE_CHIPS, f"frames where they were sent, got one {off:.2f} chips off")
        expect(frame == one.frame, f"number {frame} of the frame at {one.t_us:.0f} us, got {one.frame}")
        wanted, got = bar.symbols[int(packet), frame].tolist(), one.soft.symbols.tolist()
        expect(got == wanted, f"symbols {wanted}, got {got}")


@law("bounded", "a state of bounded size, however long the stream is")
def _check_bounded(subject: Subject) -> None:
    link, deframer = _compile_machine(subject)
    rng = np.random.default_rng(0)
    state, now_us, n = deframer.init(), 0, 500
    step_us = max(_STEP_US, round(link.packet.packet_us / 4))
    for _ in range(40):
        t_us = np.sort(rng.integers(now_us, now_us + step_us, n))
        now_us += step_us
        noise = Events.of(t_us, np.zeros(n), np.zeros(n), rng.integers(0, 2, n))
        state, _ = deframer.step(state, noise, now_us)
    size = len(pickle.dumps(state))
    what = f"a state of at most {_MAX_BYTES} bytes after ten packets of noise, got {size}"
    expect(size <= _MAX_BYTES, what)


FRAMING = (
    _check_clean,
    law("any-split", "any split of the events gives the same frames")(_check_any_split),
    _check_state_kept,
    _check_bounded,
)
"""Laws of framing."""


@law("shapes", "regions of finite places and sizes, each of another id; one where a bar is, or a light")
def _check_region_shapes(subject: Subject) -> None:
    link, detector = _compile_machine(subject)
    events = _make_recording(subject, link)
    found = feed_events(detector, events, _step_times(events))
    if link.bar.clusters > 1 and not any(found):
        # A detector of single lights finds none in a bar.
        _check_region_shapes.test(replace(subject, link=single_cluster_link(link)))
        return
    for regions in found:
        ids = [region.id for region in regions]
        expect(len(set(ids)) == len(ids), f"regions of different ids, got {ids}")
        for region in regions:
            values = region.x_px, region.y_px, region.width_px, region.height_px
            expect(np.isfinite(values).all(), f"finite places and sizes, got {region}")
    expect(any(found), "a region in a recording of a bar, or of one light; got none")


DETECTION = (_check_region_shapes, _check_state_kept)
"""Laws of detection."""


@law("shapes", "locks of finite numbers, quality in range")
def _check_lock_shapes(subject: Subject) -> None:
    link, synchronizer = _compile_machine(subject)
    events = _make_recording(subject, link)
    for lock in feed_events(synchronizer, events, _step_times(events)):
        expect(isinstance(lock, SyncLock), f"SyncLock, got {type(lock).__name__}")
        for name in ("packet_t_us", "chip_us", "delay_on_us", "delay_off_us", "quality"):
            value = getattr(lock, name)
            expect(isinstance(value, float) and np.isfinite(value), f"a finite float {name}, got {value!r}")
        expect(0 <= lock.quality <= 1, f"a quality from 0 to 1, got {lock.quality}")


@law("finds-time", "packets and clock rate of an ideal recording, one lock a packet")
def _check_timing(subject: Subject) -> None:
    link, synchronizer = _compile_machine(subject)
    for ppm, start_us in ((0.0, 5000.0), (60.0, 3333.0), (-60.0, 7777.0)):
        bar = bar_in_sight(link, random_symbols(link, _PACKETS), ppm=ppm, start_us=start_us)
        events = ideal_events(link, bar)
        locks = feed_events(synchronizer, events, _step_times(events))
        # The first packet starts with the recording, and may be found or not.
        expect(
            _PACKETS - 1 <= len(locks) <= _PACKETS,
            f"one lock a packet of {_PACKETS}, or all but the first; got {len(locks)}",
        )
        chip_us = link.packet.chip_us / (1 + ppm * 1e-6)
        packet_us = chip_us * link.packet.packet_chips
        for lock in locks:
            off_us = (lock.packet_t_us - start_us + packet_us / 2) % packet_us - packet_us / 2
            expect(
                abs(off_us) <= chip_us / 2,
                f"packets at {start_us} us and whole periods later, to half a chip; got {off_us:+.1f} us",
            )
        rate = (locks[-1].chip_us / chip_us - 1) * 1e6
        most = 1e6 * _RATE_CHIPS / link.packet.packet_chips
        expect(abs(rate) <= most, f"chips of {chip_us:.4f} us within {most:.0f} ppm, got {rate:+.0f} ppm")


@law("no-lock-in-noise", "no lock in silence and in noise")
def _check_noise(subject: Subject) -> None:
    _, synchronizer = _compile_machine(subject)
    for rate_hz in (0.0, 1e5, 2e6):
        rng = np.random.default_rng(int(rate_hz))
        n = int(rate_hz * 0.1)
        t_us = np.sort(rng.integers(0, 100_000, n))
        noise = Events.of(t_us, np.zeros(n), np.zeros(n), rng.integers(0, 2, n))
        locks = feed_events(synchronizer, noise, [*range(_STEP_US, 100_000, _STEP_US), 100_000 + _FLUSH_US])
        expect(not locks, f"no lock in noise of {rate_hz:g} events/s, got {len(locks)}")


SYNCHRONIZATION = (
    _check_lock_shapes,
    _check_timing,
    law("any-split", "any split of the events gives the same locks")(_check_any_split),
    _check_state_kept,
    _check_noise,
)
"""Laws of synchronization."""


def _make_line(frames: int) -> Any:
    return (50.0 - 8.0 * np.arange(frames) * FRAME_US * 1e-6)[:, None]


def _make_noisy_line(n: int, frames: int = 200) -> Any:
    return _make_line(frames) + np.random.default_rng(0).normal(0, 0.1, (frames, n))


@law("shapes", "float64 values and a positive sigma; no prediction at first")
def _check_filter_shapes(subject: Subject) -> None:
    for name, follow, n in filters_of(subject):
        state = follow.init()
        expect(follow.predict(state, 0.0) is None, f"{name}: a prediction of None before any measurement")
        for i, value in enumerate(_make_noisy_line(n, 5)):
            measurement = value.copy()
            state, filtered, sigma = follow.step(state, i * FRAME_US, measurement, 0.1)
            expect((measurement == value).all(), f"{name}: the measurement to stay as it was")
            predicted = follow.predict(state, (i + 1) * FRAME_US)
            expect(predicted is not None, f"{name}: a prediction after a measurement")
            for values, spread, what in ((filtered, sigma, "step"), (*predicted, "predict")):
                expect(
                    isinstance(values, np.ndarray) and values.shape == (n,) and values.dtype == np.float64,
                    f"{name}: {what} to give float64 ({n},), got {values!r}",
                )
                expect(
                    isinstance(spread, float) and spread > 0,
                    f"{name}: {what} to give a sigma above 0 as a float, got {spread!r}",
                )


@law("any-split", "predictions, branches and pickled states change nothing")
def _check_predictions_are_pure(subject: Subject) -> None:
    def make_peek(follow: Any, n: int) -> Callable[[Any, float], Any]:
        def peek(state: Any, t_us: float) -> Any:
            follow.predict(state, t_us)
            follow.predict(state, t_us + 50_000)
            # A branch that is given up.
            follow.step(state, t_us + 10, np.full(n, 1e3), 1.0)
            return pickle.loads(pickle.dumps(state))

        return peek

    for name, follow, n in filters_of(subject):
        values = _make_noisy_line(n, 40)
        got, wanted = run_filter(follow, values, make_peek(follow, n)), run_filter(follow, values)
        expect_same(got, wanted, "predictions, branches and pickling not to change what follows", name=name)


@law("straight-line", "less error than measured on a straight line, none at rest")
def _check_straight_line(subject: Subject) -> None:
    for name, follow, n in filters_of(subject):
        values = _make_noisy_line(n)
        late = slice(len(values) // 2, None)
        filtered = np.array([f for f, _ in run_filter(follow, values)])
        off = [(v - _make_line(len(values)))[late] for v in (values, filtered)]
        raw, left = (float(np.sqrt((v**2).mean())) for v in off)
        expect(
            left <= raw * 1.001,
            f"{name}: no more error than measured on a straight line, {raw:.3f}, got {left:.3f}",
        )
        end = run_filter(follow, np.full((100, n), 42.0))[-1][0]
        expect(np.allclose(end, 42.0, atol=1e-6), f"{name}: 42 from measurements of 42, got {end}")


TRACKING = (_check_filter_shapes, _check_predictions_are_pure, _check_straight_line)
"""Laws of tracking."""
