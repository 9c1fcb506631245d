"""Laws of what keeps state: synchronization and tracking."""

import pickle
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.testing.exercises import compiled_subject, filters_of, link_of
from evlcp_sdk.testing.law import Law, Subject, expect
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.testing.trees import difference
from evlcp_sdk.values import Events, SyncLock

__all__ = ["SYNCHRONIZATION", "TRACKING"]

_PACKETS = 4
_STEP_US = 1500
_RATE_CHIPS = 0.02
"""Error of the clock rate over a packet, in chips: a fiftieth moves no edge; 58 ppm of the default packet's
346 chips. Of few pixels and short packets the events' own scatter leaves up to half of it."""
_SAME_US = 1e-9
"""Relative: 0.1 ns in the times of these recordings."""
_FRAME_US = 3200.0
_FLUSH_US = 100_000


def _recording(link: Link, ppm: float = 0.0, start_us: float = 5000.0) -> Events:
    bar = IdealBar(random_symbols(link, _PACKETS), ppm=ppm, start_us=start_us)
    return ideal_events(link, bar)


def _locks(synchronizer: Any, events: Events, until_us: Sequence[int]) -> list[SyncLock]:
    """Locks of a recording that is cut at times."""
    state = synchronizer.init()
    locks: list[SyncLock] = []
    begin = 0
    for until in until_us:
        end = int(np.searchsorted(events.t_us, until))
        state, found = synchronizer.step(state, events.t_us[begin:end], events.p[begin:end], until)
        locks += found
        begin = end
    return locks


def _steps(events: Events) -> list[int]:
    last = int(events.t_us[-1]) + 1
    return [*range(_STEP_US, last + _STEP_US, _STEP_US), last + _FLUSH_US]


def _synchronizer(subject: Subject) -> tuple[Link, Any]:
    return link_of(subject), compiled_subject(subject)


def locks_shapes(subject: Subject) -> None:
    """Hold the law."""
    link, synchronizer = _synchronizer(subject)
    events = _recording(link)
    for lock in _locks(synchronizer, events, _steps(events)):
        expect(isinstance(lock, SyncLock), f"SyncLock, got {type(lock).__name__}")
        for name in ("packet_t_us", "chip_us", "delay_on_us", "delay_off_us", "quality"):
            value = getattr(lock, name)
            expect(isinstance(value, float) and np.isfinite(value), f"a finite float {name}, got {value!r}")
        expect(0 <= lock.quality <= 1, f"a quality from 0 to 1, got {lock.quality}")


def finds_time(subject: Subject) -> None:
    """Hold the law."""
    link, synchronizer = _synchronizer(subject)
    for ppm, start_us in ((0.0, 5000.0), (60.0, 3333.0), (-60.0, 7777.0)):
        events = _recording(link, ppm, start_us)
        locks = _locks(synchronizer, events, _steps(events))
        # The first packet's beginning is the recording's: it may be found or not.
        expect(
            _PACKETS - 1 <= len(locks) <= _PACKETS,
            f"one lock a packet of {_PACKETS}, or all but the first; got {len(locks)}",
        )
        chip_us = link.packet.chip_us / (1 + ppm * 1e-6)
        for lock in locks:
            packets = (lock.packet_t_us - start_us) / (chip_us * link.packet.packet_chips)
            off_us = (packets - round(packets)) * chip_us * link.packet.packet_chips
            expect(
                abs(off_us) <= chip_us / 2,
                f"packets at {start_us} us and whole periods later, to half a chip; got {off_us:+.1f} us",
            )
        rate = (locks[-1].chip_us / chip_us - 1) * 1e6
        most = 1e6 * _RATE_CHIPS / link.packet.packet_chips
        expect(abs(rate) <= most, f"chips of {chip_us:.4f} us within {most:.0f} ppm, got {rate:+.0f} ppm")


def any_split(subject: Subject) -> None:
    """Hold the law."""
    link, synchronizer = _synchronizer(subject)
    events = _recording(link)
    wanted = _locks(synchronizer, events, _steps(events))
    last = int(events.t_us[-1]) + 1
    rng = np.random.default_rng(0)
    cuts = {
        "all at once": [last + _FLUSH_US],
        "at random": [*np.sort(rng.integers(1, last, 200)).tolist(), last + _FLUSH_US],
        "every 137 us": [*range(137, last, 137), last + _FLUSH_US],
    }
    for how, until_us in cuts.items():
        differs = difference(_locks(synchronizer, events, until_us), wanted, _SAME_US, "locks")
        expect(differs is None, f"the same locks from events fed {how} as every {_STEP_US} us; {differs}")


def sync_state_kept(subject: Subject) -> None:
    """Hold the law."""
    link, synchronizer = _synchronizer(subject)
    events = _recording(link)
    half = len(events) // 2
    middle, end = int(events.t_us[half]), int(events.t_us[-1]) + _FLUSH_US
    state, _ = synchronizer.step(synchronizer.init(), events.t_us[:half], events.p[:half], middle)

    def rest() -> Any:
        return synchronizer.step(state, events.t_us[half:], events.p[half:], end)[1]

    first = rest()
    differs = difference(rest(), first, name="locks")
    expect(differs is None, f"a step not to change the state it is given: the same locks again; {differs}")
    state = pickle.loads(pickle.dumps(state))
    differs = difference(rest(), first, name="locks")
    expect(differs is None, f"the same locks from a pickled state; {differs}")


def no_lock_in_noise(subject: Subject) -> None:
    """Hold the law."""
    _, synchronizer = _synchronizer(subject)
    for rate_hz in (0.0, 1e5, 2e6):
        rng = np.random.default_rng(int(rate_hz))
        n = int(rate_hz * 0.1)
        t_us = np.sort(rng.integers(0, 100_000, n))
        noise = Events.of(t_us, np.zeros(n), np.zeros(n), rng.integers(0, 2, n))
        locks = _locks(synchronizer, noise, [*range(_STEP_US, 100_000, _STEP_US), 100_000 + _FLUSH_US])
        expect(not locks, f"no lock in noise of {rate_hz:g} events/s, got {len(locks)}")


def _track(follow: Any, values: Any, peek: Callable[[Any, float], Any] | None = None) -> list[Any]:
    state = follow.init()
    out = []
    for i, value in enumerate(values):
        t_us = i * _FRAME_US
        if peek is not None:
            state = peek(state, t_us)
        state, filtered, sigma = follow.step(state, t_us, value, 0.1)
        out.append((filtered, sigma))
    return out


def _measured(n: int, frames: int = 200) -> Any:
    """A straight line with noise of 0.1, float64 (frames, n)."""
    line = 50.0 - 8.0 * np.arange(frames) * _FRAME_US * 1e-6
    return line[:, None] + np.random.default_rng(0).normal(0, 0.1, (frames, n))


def filter_shapes(subject: Subject) -> None:
    """Hold the law."""
    for name, follow, n in filters_of(subject):
        state = follow.init()
        expect(follow.predict(state, 0.0) is None, f"{name}: a prediction of None before any measurement")
        for i, value in enumerate(_measured(n, 5)):
            given = value.copy()
            state, filtered, sigma = follow.step(state, i * _FRAME_US, given, 0.1)
            expect((given == value).all(), f"{name}: the measurement to stay as it was")
            ahead = follow.predict(state, (i + 1) * _FRAME_US)
            expect(ahead is not None, f"{name}: a prediction after a measurement")
            for values, spread, what in ((filtered, sigma, "step"), (*ahead, "predict")):
                expect(
                    isinstance(values, np.ndarray) and values.shape == (n,) and values.dtype == np.float64,
                    f"{name}: {what} to give float64 ({n},), got {values!r}",
                )
                expect(
                    isinstance(spread, float) and spread > 0,
                    f"{name}: {what} to give a sigma above 0 as a float, got {spread!r}",
                )


def looking_changes_nothing(subject: Subject) -> None:
    """Hold the law."""

    def branches(follow: Any) -> Callable[[Any, float], Any]:
        def peek(state: Any, t_us: float) -> Any:
            follow.predict(state, t_us)
            follow.predict(state, t_us + 50_000)
            # A branch that is given up.
            follow.step(state, t_us + 10, np.full(2 if follow is position else 1, 1e3), 1.0)
            return pickle.loads(pickle.dumps(state))

        return peek

    found = filters_of(subject)
    position = next((f for name, f, _ in found if name == "position"), None)
    for name, follow, n in found:
        values = _measured(n, 40)
        differs = difference(_track(follow, values, branches(follow)), _track(follow, values), name=name)
        expect(
            differs is None,
            f"predictions, branches and pickling not to change what follows; {differs}",
        )


def follows_a_line(subject: Subject) -> None:
    """Hold the law."""
    for name, follow, n in filters_of(subject):
        values = _measured(n)
        line = 50.0 - 8.0 * np.arange(len(values)) * _FRAME_US * 1e-6
        late = slice(len(values) // 2, None)
        filtered = np.array([f for f, _ in _track(follow, values)])
        raw, left = (float(np.sqrt(((v[late] - line[late, None]) ** 2).mean())) for v in (values, filtered))
        expect(
            left <= raw * 1.001,
            f"{name}: no more error than measured on a straight line, {raw:.3f}, got {left:.3f}",
        )
        still = np.full((100, n), 42.0)
        end = _track(follow, still)[-1][0]
        expect(np.allclose(end, 42.0, atol=1e-6), f"{name}: 42 from measurements of 42, got {end}")


SYNCHRONIZATION = (
    Law("shapes", "locks of finite numbers, quality in range", locks_shapes),
    Law("finds-time", "packets and clock rate of an ideal recording, one lock a packet", finds_time),
    Law("any-split", "any split of the events gives the same locks", any_split),
    Law("state-kept", "a step leaves the state it is given, which can be pickled", sync_state_kept),
    Law("no-lock-in-noise", "no lock in silence and in noise", no_lock_in_noise),
)
"""Laws of synchronization."""

TRACKING = (
    Law("shapes", "float64 values and a positive sigma; no prediction at first", filter_shapes),
    Law("any-split", "predictions, branches and pickled states change nothing", looking_changes_nothing),
    Law("straight-line", "less error than measured on a straight line, none at rest", follows_a_line),
)
"""Laws of tracking."""
