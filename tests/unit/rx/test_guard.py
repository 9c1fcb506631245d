"""An algorithm that fails is told by name, in one line."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rx_streams import lit

from evlcp_sdk.errors import ConfigError, InputError, PluginError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Corrected, Tracker
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Curvature, SyncLock

LINK = load_link(overrides=["tracking.id=kalman"])
_, EVENTS = lit(2)
ROLES = ("synchronization", "separation", "decoding", "ranging", "tracking")


def raises(fault):
    def act(*_args):
        raise fault

    return act


fails = raises(KeyError("boom"))


class MuteError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


def link_with(role, compiled):
    return LINK.with_algorithm(role, SimpleNamespace(compile=compiled), id="mine")


def receive_stream(link):
    receiver = Receiver(link)
    receiver.feed(EVENTS)
    receiver.close()


class Changed:
    """An object that gives something else at one of its methods."""

    def __init__(self, inner, method, change):
        self._inner, self._method, self._change = inner, method, change

    def __getattr__(self, name):
        found = getattr(self._inner, name)
        return (lambda *given: self._change(found(*given))) if name == self._method else found


def change_algorithm(role, change):
    """The link with an algorithm that gives something else than the built-in one."""
    built_in = LINK.algorithm(role)

    def of_steps(found):
        return found[0], [change(lock) for lock in found[1]]

    def of_filter(found):
        return found[0], *change(found[1:])

    def of_compiled(made):
        if role == "synchronization":
            return Changed(made, "step", of_steps)
        if role == "tracking":
            return Tracker(*(Changed(one, "step", of_filter) for one in (made.position, made.distance)))
        return lambda *data: change(made(*data))

    return link_with(role, lambda *given: of_compiled(built_in.compile(*given)))


@pytest.mark.parametrize(
    ("role", "fault", "message"),
    [
        *((role, KeyError("boom"), "KeyError: 'boom'") for role in ROLES),
        ("ranging", SystemExit(0), "SystemExit: 0"),
        ("ranging", MuteError(), "MuteError: a MuteError that cannot be shown"),
        ("ranging", InputError("liar.raw: damaged"), "InputError: liar.raw: damaged"),
    ],
)
def test_what_fails_in_a_frame_is_named(role, fault, message):
    with pytest.raises(PluginError) as caught:
        receive_stream(change_algorithm(role, raises(fault)))
    assert str(caught.value).startswith(f"{role} algorithm 'mine': {message} (test_guard.py, line ")
    assert str(caught.value).endswith(f"; try: evlcp check {role} mine")
    assert caught.value.__cause__ is fault


def test_an_interrupt_in_an_algorithm_is_the_user_s():
    with pytest.raises(KeyboardInterrupt):
        receive_stream(change_algorithm("ranging", raises(KeyboardInterrupt())))


@pytest.mark.parametrize("role", ROLES)
def test_what_fails_to_compile_is_named_and_what_it_refuses_stays(role):
    with pytest.raises(PluginError, match=f"{role} algorithm 'mine': KeyError"):
        Receiver(link_with(role, fails))
    with pytest.raises(ConfigError, match=r"^ranging\.clusters"):
        Receiver(link_with(role, raises(ConfigError("ranging.clusters = [99]: expected 0 to 15"))))


FUNCTION, METHODS = "a function", r"an object with init\(\) and step\(\)"


@pytest.mark.parametrize(
    ("role", "gives", "message"),
    [
        ("synchronization", SimpleNamespace(init=None, step=fails), f"SimpleNamespace at .*{METHODS}"),
        ("decoding", 3, rf"int at compile\(\), expected {FUNCTION}"),
        ("tracking", Tracker(None, 5), r"int at compile\(\), .* init\(\) and step\(\) and predict\(\)"),
    ],
)
def test_what_compiles_to_nothing_that_runs_is_named(role, gives, message):
    with pytest.raises(PluginError, match=f"^{role} algorithm 'mine': gave {message}; try: evlcp check"):
        Receiver(link_with(role, lambda *_: gives))


def test_more_locks_than_a_step_has_room_for_are_refused():
    lock = SyncLock(0.0, 100.0, 10.0, 20.0, 1.0)
    gives = SimpleNamespace(init=lambda: None, step=lambda *_: (None, [lock] * 1001))
    with pytest.raises(PluginError, match=r"gave 1001 locks in a step, expected at most 1000"):
        receive_stream(link_with("synchronization", lambda *_: gives))


def but(**changes):
    return lambda found: replace(found, **changes)


def spoilt(name, value, kind=None):
    """One value of an array is another."""

    def change(found):
        array = getattr(found, name).astype(kind or getattr(found, name).dtype, copy=True)
        array.flat[0] = value
        return replace(found, **{name: array})

    return change


CURVED = replace(Curvature(*np.ones((3, 3))), phase_bias=np.zeros(2))
"""Of three boundaries."""

ODD = [
    ("synchronization", lambda _: (0.0, 100.0), "tuple, expected SyncLock"),
    ("synchronization", but(chip_us=-100.0), r"chip_us = -100\.0, expected a number from 50 to 200"),
    ("synchronization", but(packet_t_us=-1e15), r"packet_t_us = -1000000000000000\.0, expected"),
    ("synchronization", but(delay_on_us=math.inf), "delay_on_us = inf, expected"),
    ("synchronization", but(quality=2.0), r"quality = 2\.0, expected a number from 0 to 1"),
    ("separation", lambda _: None, "NoneType, expected PresenceMap"),
    ("separation", but(grid_px=10**6), r"probability of shape \(16, \d+, \d+\), expected \(16, 0, 0\)"),
    ("separation", but(grid_px=0), "grid_px = 0, expected a whole number of pixels from 1"),
    ("separation", but(probability=[0.5]), "probability of type list, expected an array"),
    ("separation", spoilt("probability", math.nan), "probability of other values, expected 0 to 1"),
    ("separation", but(prior=np.zeros(3)), r"prior of shape \(3,\), expected"),
    ("separation", spoilt("pixels", math.inf), "pixels of other values, expected finite ones"),
    ("separation", spoilt("selected", 1, np.int64), "selected of int64, expected booleans"),
    ("separation", lambda p: replace(p, pixels=p.pixels[:, 1:]), r"pixels of shape"),
    ("decoding", lambda _: "text", "str, expected SoftSymbols"),
    ("decoding", but(symbols=np.zeros(3, int)), r"symbols of shape \(3,\), expected \(16,\)"),
    ("decoding", spoilt("symbols", -2), "symbol -2, expected 0 to 63, or -1 for one not given"),
    ("decoding", but(llr=np.zeros((16, 4))), r"llr of shape \(16, 4\), expected \(16, 6\)"),
    ("decoding", spoilt("llr", math.nan), "llr of other values, expected finite ones"),
    ("ranging", lambda _: 50.0, "float, expected Range"),
    ("ranging", but(distance_m=0.0), r"distance_m = 0\.0, expected a number above 0 and up to 1e\+15"),
    ("ranging", but(distance_m=10**5000), "distance_m = a int that cannot be shown"),
    ("ranging", but(sigma_m=-1.0), r"sigma_m = -1\.0, expected a number from 0, or NaN"),
    ("ranging", but(curvature=3), "int, expected Curvature"),
    ("ranging", but(curvature=CURVED), r"curvature.phase_bias of shape \(2,\), expected \(3,\)"),
    ("ranging", but(curvature=Curvature(*np.ones((3, 3, 1)))), r"curvature.place of shape \(3, 1\)"),
    ("tracking", lambda found: (found[0] * math.nan, found[1]), r"values \[nan"),
    ("tracking", lambda found: (found[0][:0], found[1]), r"values of shape \(0,\), expected"),
    ("tracking", lambda found: (found[0], "a lot"), "sigma = 'a lot', expected a number"),
]


@pytest.mark.parametrize(("role", "change", "message"), ODD)
def test_what_no_next_stage_can_work_with_is_named(role, change, message):
    named = rf"^{role} algorithm 'mine': gave {message}.*; try: evlcp check"
    with pytest.raises(PluginError, match=named) as caught:
        receive_stream(change_algorithm(role, change))
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("role", "change"),
    [
        ("synchronization", but(chip_us=np.float32(100.0))),
        ("decoding", lambda soft: replace(soft, symbols=soft.symbols.astype(np.int16))),
        ("ranging", but(distance_m=math.nan, sigma_m=math.nan, pairs=0)),
    ],
)
def test_other_types_of_right_values_pass(role, change):
    receive_stream(change_algorithm(role, change))


@pytest.mark.parametrize(
    ("gives", "message"),
    [
        (None, "TypeError: gave NoneType, expected Corrected"),
        (Corrected(np.zeros(3, np.uint8), True, 0), r"ValueError: gave bits of shape \(3,\), expected"),
    ],
)
def test_an_error_correction_that_gives_another_thing_is_named(gives, message):
    built_in = LINK.algorithm("error-correction")

    def compile_code(length):
        return Changed(built_in.compile(length), "decode", lambda _: gives)

    for compiled, expected in (
        (compile_code, message),
        (lambda _: None, "TypeError: gave NoneType with message_bits"),
    ):
        with pytest.raises(PluginError, match=f"^error-correction algorithm 'mine': {expected}"):
            receive_stream(link_with("error-correction", compiled))


def test_a_hook_that_exits_ends_nothing():
    class Exits:
        @hookimpl
        def evlcp_stage_finished(self, stage):
            raise SystemExit(0)

    with pytest.raises(PluginError, match=r"^evlcp_stage_finished\(\) of a plugin: SystemExit: 0"):
        Receiver(LINK, Registry.load(Exits()).hook).feed(EVENTS)
