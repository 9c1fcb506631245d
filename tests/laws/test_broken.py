"""The laws themselves: a deliberately broken algorithm for each must fail it, and for the right reason."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evlcp_barker.synchronization import BarkerSync
from evlcp_centroid.ranging import CentroidRanging
from evlcp_kalman.tracking import KalmanTracking
from evlcp_polar.correction import Polar
from evlcp_regions.detection import Whole
from evlcp_uart.framing import Uart
from evlcp_wh.decoding import WhTransform
from evlcp_wh.modulation import Wh8
from evlcp_wh.pilots import WhPilots
from evlcp_wh.separation import WhCorrelation

from evlcp_sdk.air.codebook import chips_of_values
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.roles import ROLES, Ranging, Tracker
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.testing import LawError, laws_of
from evlcp_sdk.testing.form import DESCRIPTION, FUNCTION, RESULT
from evlcp_sdk.testing.law import Subject
from evlcp_sdk.testing.links import LINK
from evlcp_sdk.values import SyncLock

Change = Callable[..., Any]


@dataclass(frozen=True)
class Changed:
    """A built-in algorithm, what a method of which gives is changed."""

    inner: Any
    method: str
    change: Change

    def __getattr__(self, name):
        found = getattr(self.inner, name)
        return (lambda *given: self.change(found(*given))) if name == self.method else found


def change_compiled(inner):
    """What changes the function that an algorithm compiles to; `change(function) -> function`."""
    return lambda change: Changed(inner, "compile", change)


separation = change_compiled(WhCorrelation())
decoding = change_compiled(WhTransform())
ranging = change_compiled(CentroidRanging())
tracking = change_compiled(KalmanTracking())


def change_result(change):
    """Tamper with the result."""
    return lambda function: lambda *given: change(function(*given))


def change_fields(**fields):
    """Tamper with fields of the result."""

    def change(found):
        return replace(found, **{name: by(getattr(found, name)) for name, by in fields.items()})

    return change_result(change)


def act_first(act):
    """Do something to the inputs first."""

    def tamper(function):
        def call(*given):
            act(*given)
            return function(*given)

        return call

    return tamper


# Form.


@dataclass(frozen=True)
class NoDefault(CentroidRanging):
    focus_m: float = field(kw_only=True)


@dataclass
class Thawed(Ranging):
    def compile(self, *given):
        return CentroidRanging().compile(*given)


@dataclass(frozen=True)
class Forgetful(CentroidRanging):
    def __post_init__(self):
        object.__setattr__(self, "min_clusters", self.min_clusters + 1)


@dataclass(frozen=True)
class Refusing(Ranging):
    def compile(self, *given):
        raise ConfigError("a panel of 7 x 3 clusters only")


def one_buffer(function):
    kept = {}

    def separate(sums):
        found = kept.setdefault("map", function(sums))
        new = function(sums)
        found.pixels[...] = new.pixels
        return found

    return separate


# Codes.


def star(codes):
    """One code, and others that differ from it in one value."""
    out = np.ones((len(codes), 32), np.int8)
    out[np.arange(1, len(codes)), np.arange(1, len(codes))] = -1
    return chips_of_values(out)


TWINS = np.r_[0, 0, 2:16]
"""Where the second code is the first one again."""


# Streams.


@dataclass(frozen=True)
class Stepping:
    """A synchronizer, detector or deframer in whose `step` something is changed; its state is a list."""

    inner: Any
    change: Change

    def init(self):
        return [self.inner.init(), b""]

    def step(self, state, *given):
        return self.change(self.inner, state, *given)

    def close(self, state):
        return state, self.inner.close(state[0])[1]

    def counts(self, state):
        return self.inner.counts(state[0])


def stepping(inner):
    return lambda change: Changed(inner, "compile", lambda made: Stepping(made, change))


sync = stepping(BarkerSync())
detection = stepping(Whole())
framing = stepping(Uart())


def giving(change):
    """A step whose results are changed."""

    def step(inner, state, *given):
        then, found = inner.step(state[0], *given)
        return [then, state[1]], change(found)

    return step


def mutating(inner, state, *given):
    state[0], found = inner.step(state[0], *given)
    return state, found


def locks_changed(change):
    return sync(giving(lambda locks: [change(lock) for lock in locks]))


def amnesic(inner, state, *given):
    return state, inner.step(inner.init(), *given)[1]


def credulous(inner, state, t_us, p, until_us):
    then, locks = inner.step(state[0], t_us, p, until_us)
    invented = [SyncLock(float(until_us), 100.0, 0.0, 0.0, 0.9)] if len(t_us) > 10 else []
    return [then, b""], [*locks, *invented]


def grown(inner, state, start_us, events):
    found, regions = inner.step(state[0], start_us, events)
    state[0] = replace(found, number=found.number + 1)
    return state, regions


def forgetful_framing(inner, state, events, until_us):
    """Every step but those of many events is forgotten."""
    if len(events) < 200:
        return state, []
    found, frames = inner.step(state[0], events, until_us)
    return [found, b""], frames


def growing_framing(inner, state, events, until_us):
    found, frames = inner.step(state[0], events, until_us)
    return [found, state[1] + bytes(1 << 17)], frames


@dataclass(frozen=True)
class Smoothing:
    """Exponential smoothing, which lags; parts of it broken on demand."""

    early: bool = False
    nosy: bool = False
    off_m: float = 0.0

    def init(self):
        return {"at": None, "looked": 0}

    def predict(self, state, t_us):
        if self.nosy:
            state["looked"] += 1
        if state["at"] is None:
            return (np.zeros(1), 1.0) if self.early else None
        return state["at"], 1.0

    def step(self, state, t_us, value, sigma):
        at = value.copy() if state["at"] is None else state["at"] + 0.02 * (value - state["at"])
        at = at + state["looked"]
        return {"at": at, "looked": state["looked"]}, at + self.off_m, sigma


def smoothing(**how):
    return tracking(lambda _: Tracker(position=None, distance=Smoothing(**how)))


# Images.


def without_events(found):
    return found if found.selected.any() else replace(found, selected=~found.selected)


def leaning(function):
    def measure(view):
        rows = np.nonzero(view.presence.selected.any((0, 2)))[0]
        found = function(view)
        return replace(found, distance_m=found.distance_m * (1 + 0.01 * float(rows.mean())))

    return measure


class OneCamera(CentroidRanging):
    def compile(self, camera, bar, codebook):
        return super().compile(CameraModel(), bar, codebook)


class OneOrder(WhCorrelation):
    def compile(self, codebook):
        return super().compile(load_link().codebook)


def numbered(soft):
    return replace(soft, llr=soft.llr * np.arange(1, len(soft.llr) + 1, dtype=np.float32)[:, None])


# Error correction.


def code_changed(**change):
    """A code whose ends are changed: its bits and coded bits, its LLRs and what is found."""

    def by(name, value):
        return change[name](value) if name in change else value

    def tamper(code):
        return SimpleNamespace(
            message_bits=code.message_bits,
            coded_bits=code.coded_bits,
            encode=lambda bits: by("coded", code.encode(by("bits", bits))),
            decode=lambda llr: by("found", code.decode(by("llr", llr))),
        )

    return Changed(Polar(), "compile", tamper)


GULLIBLE = lambda found: replace(found, ok=found.ok or found.flipped > 0)  # noqa: E731
"""The check is not asked where some bits were put right."""

BROKEN = {
    "form": [
        ("defaults", NoDefault(focus_m=1.0), "a default of field 'focus_m'"),
        ("frozen", Thawed(), "frozen=True"),
        ("described", Refusing(), "a docstring of class Refusing"),
        ("round-trip", Forgetful(), "min_clusters=7"),
        ("picklable", ranging(lambda function: function), "pickle"),
        ("compiles", Refusing(), "got: a panel of 7 x 3 clusters only"),
        ("inputs-kept", ranging(act_first(lambda view: view.sums.fill(0))), "inputs to stay as they were"),
        ("read-only", ranging(act_first(lambda view: view.presence.pixels.sort())), "read-only"),
        ("non-contiguous", ranging(act_first(lambda view: view.sums.data.cast("b"))), "contiguous"),
        (
            "deterministic",
            ranging(change_fields(distance_m=lambda d: d + np.random.random())),  # noqa: NPY002
            "the same result when called again",
        ),
        ("deterministic", ranging(act_first(lambda _: np.random.random())), "take a Generator"),  # noqa: NPY002
    ],
    "pilots": [
        ("shapes", Changed(WhPilots(), "codes", lambda codes: codes.astype(float)), "uint8"),
        ("pilots-apart", Changed(WhPilots(), "codes", star), "correlate by 0.25 at most"),
        (
            "sharp-preamble",
            Changed(WhPilots(), "preamble", lambda _: chips_of_values(np.ones(13))),
            "sidelobes",
        ),
        ("tells-apart", Changed(WhPilots(), "codes", star), "of cluster 0, whose pilot has [0-9]+ edges"),
    ],
    "modulation": [
        ("shapes", Changed(Wh8(), "codewords", lambda words: words[:1]), "two codewords or more, got 1"),
        (
            "codewords-distinct",
            Changed(Wh8(), "codewords", lambda codes: codes[TWINS]),
            "16 codewords of different edges, got 15",
        ),
        ("comes-back", Changed(Wh8(), "codewords", lambda codes: codes[TWINS]), "are equal"),
    ],
    "detection": [
        ("shapes", detection(giving(lambda regions: [*regions, *regions])), "regions of different ids"),
        ("shapes", detection(giving(lambda regions: [])), "a region in a recording"),
        ("state-kept", detection(grown), "not to change the state"),
    ],
    "framing": [
        ("clean", framing(giving(lambda frames: [])), "got 0"),
        (
            "clean",
            framing(giving(lambda frames: [replace(f, t_us=f.t_us + 200) for f in frames])),
            "chips off",
        ),
        ("any-split", framing(forgetful_framing), "the same frames from events fed"),
        ("state-kept", framing(mutating), "not to change the state"),
        ("bounded", framing(growing_framing), "a state of at most"),
    ],
    "synchronization": [
        ("shapes", locks_changed(lambda lock: replace(lock, quality=2.0)), "quality from 0 to 1"),
        (
            "finds-time",
            locks_changed(lambda lock: replace(lock, packet_t_us=lock.packet_t_us + 70)),
            "to half a chip",
        ),
        ("finds-time", locks_changed(lambda lock: replace(lock, chip_us=1.0001 * lock.chip_us)), "58 ppm"),
        ("finds-time", sync(lambda inner, state, *given: (state, [])), "one lock a packet"),
        ("any-split", sync(amnesic), "the same locks from events fed"),
        ("state-kept", sync(mutating), "not to change the state"),
        ("no-lock-in-noise", sync(credulous), "no lock in noise"),
    ],
    "separation": [
        (
            "shapes",
            separation(change_fields(probability=lambda p: p.astype(float))),
            "probability as float32",
        ),
        (
            "finds-clusters",
            separation(change_fields(selected=lambda s: np.roll(s, 1, 0))),
            "each cluster's pixels",
        ),
        ("sees-nothing", separation(change_result(without_events)), "no cell selected without events"),
        ("permutes", OneOrder(), "in another order"),
        ("results-owned", separation(one_buffer), "not to change the next"),
    ],
    "decoding": [
        ("shapes", decoding(change_fields(llr=lambda x: x.astype(float))), "llr as float32"),
        ("inverts", decoding(change_fields(symbols=lambda s: s ^ 1)), "profile raw8: symbol 0, got 1"),
        ("llr-agrees", decoding(change_fields(llr=lambda x: -x)), "llr > 0 where a bit is 0"),
        ("permutes", decoding(change_result(numbered)), "llr in the order"),
        ("knows-nothing", decoding(change_fields(llr=lambda x: x + 5)), "llr of 0"),
        ("clean-link", decoding(change_fields(symbols=lambda s: s ^ 1)), "no wrong symbol"),
    ],
    "ranging": [
        ("shapes", ranging(change_fields(pairs=lambda _: 0)), "pairs as a count"),
        ("exact", ranging(change_fields(distance_m=lambda d: d * 1.01)), "exactly 4 px apart"),
        ("monotone", ranging(change_fields(distance_m=lambda _: 50.0)), "distances that fall"),
        ("moved", ranging(leaning), "wherever the bar stands"),
        ("focal-length", OneCamera(), "twice the distance"),
        (
            "sees-nothing",
            ranging(change_fields(distance_m=np.nan_to_num)),
            "a distance of NaN from no cluster",
        ),
        ("clean-link", ranging(change_fields(distance_m=lambda d: d * 1.1)), "distance 54.01 m within 5%"),
    ],
    "tracking": [
        ("shapes", smoothing(early=True), "a prediction of None"),
        ("any-split", smoothing(nosy=True), "not to change what follows"),
        ("straight-line", smoothing(), "no more error than measured"),
        ("clean-link", smoothing(off_m=10.0), "filtered 54.01 m within 5%"),
    ],
    "error-correction": [
        ("shapes", code_changed(coded=lambda x: x.astype(int)), "coded bits as a uint8 array"),
        ("shapes", code_changed(found=lambda f: replace(f, flipped=np.int64(0))), "flipped as an int"),
        ("shapes", code_changed(llr=lambda x: np.resize(x, 960)), "ConfigError from decode"),
        ("shapes", code_changed(coded=lambda x: x[:-1]), r"coded bits of shape \(960,\)"),
        ("comes-back", code_changed(found=lambda f: replace(f, bits=f.bits ^ 1)), "bits wrong"),
        ("comes-back", code_changed(found=lambda f: replace(f, flipped=1)), "no bit flipped"),
        ("every-bit", code_changed(bits=lambda x: np.append(x[:1] * 0, x[1:])), "message bit 0 of 456"),
        ("knows-nothing", code_changed(found=lambda f: replace(f, ok=True)), "not ok where none of 960"),
        ("no-message-in-noise", code_changed(found=GULLIBLE), "no message in random LLRs"),
        ("errors-found", code_changed(found=GULLIBLE), "a message of 456 bits that was not sent"),
        (
            "corrects",
            code_changed(found=lambda f: replace(f, ok=f.ok and not f.flipped)),
            "the message with 9 of 960 bits wrong",
        ),
        ("corrects", code_changed(found=lambda f: replace(f, flipped=0)), "9 flipped with 9 of 960"),
        ("clean-link", code_changed(llr=lambda x: x[::-1]), "message 0 of a clean recording"),
    ],
}
"""Role (or form) to (law, algorithm that breaks it, what is said)."""

CASES = [
    pytest.param("ranging" if role == "form" else role, *case, id=f"{role}-{case[0]}-{i}")
    for role, cases in BROKEN.items()
    for i, case in enumerate(cases)
]


@pytest.mark.parametrize(("role", "name", "algorithm", "message"), CASES)
def test_the_law_finds_the_fault(role, name, algorithm, message):
    law = next(law for law in laws_of(role) if law.name == name)
    with pytest.raises(LawError, match=message):
        law.apply(Subject(role, algorithm))


@pytest.mark.parametrize("role", ROLES)
def test_every_law_has_a_broken_algorithm(role):
    of_form = {law.name for law in (*DESCRIPTION, *FUNCTION, *RESULT)}
    assert of_form <= {name for cases in BROKEN.values() for name, _, _ in cases}
    own = {law.name for law in laws_of(role)} - of_form - {law.name for law in LINK}
    assert own <= {name for name, _, _ in BROKEN[role]}
    assert len({law.name for law in laws_of(role)}) == len(laws_of(role))
