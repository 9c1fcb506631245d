"""Deliberately broken algorithms on the command line: one line that names them, and what was expected."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evlcp_uart.framing import Uart
from evlcp_wh.pilots import WhPilots

from evlcp_sdk.errors import PluginError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.plugin.hooks import Algorithm
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Detection, Modulation, Ranging, Tracking
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.simulated import simulate
from evlcp_sdk.values import DecodedFrame, SoftSymbols
from tests.conftest import Brings, rows_of

Evlcp = Callable[..., Any]

LAMP = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
AIR = {"chip_rate_hz": 10_000.0, "frames_per_packet": 20}
HERE = __name__


def boom(*_: object) -> Any:
    raise KeyError("boom")


def decoded_frame(
    t_us: float, packet: int = 0, frame: int = 0, chip_us: float = 100.0, **soft: Any
) -> DecodedFrame:
    given = {"symbols": np.array([65]), "llr": np.ones((1, 8), np.float32), "quality": 0.9}
    return DecodedFrame(packet, frame, t_us, t_us, chip_us, SoftSymbols(**given | soft))


class Steps:
    """A step function that fails, or gives something, from some step on; it counts its steps."""

    def __init__(self, gives: Callable[[int], Any], counts: Any = None) -> None:
        self.gives, self.given = gives, {} if counts is None else counts

    def init(self) -> int:
        return 0

    def step(self, state: int, first: Any, second: Any) -> Any:
        return self.gives(state) if state >= 8 else (state + 1, [])

    def close(self, state: int) -> Any:
        return state, []

    def counts(self, state: int) -> Any:
        return self.given


def step_result(state: int, *found: Any) -> Any:
    return state + 1, list(found)


@dataclass(frozen=True)
class Unfinished(Ranging):
    """Has no `compile`."""


class NoData(Ranging):
    """Is no dataclass."""

    def compile(self, *_: object) -> Any:
        return boom


def make_algorithm(base: type, **methods: Any) -> Any:
    return dataclass(frozen=True)(type("Broken", (base,), methods | {"__doc__": "Broken."}))


def steps(gives: Callable[[int], Any], counts: Any = None) -> Callable[..., Steps]:
    return lambda *_: Steps(gives, counts)


def frames(*faults: dict[str, Any]) -> Any:
    """A framing that gives frames, each with something wrong."""
    return make_algorithm(
        Uart,
        compile=steps(
            lambda n: step_result(n, *(decoded_frame(**({"t_us": n} | fault)) for fault in faults))
        ),
    )


def words(given: Any) -> Any:
    return make_algorithm(Modulation, codewords=lambda _: given)


NAN = float("nan")
LONE = np.array([[0, 1]], np.uint8)
COMPILES: dict[str, tuple[Callable[..., Any], str]] = {
    "compile fails": (boom, "KeyError: 'boom' (test_broken_algorithms.py, line "),
    "compiles to five": (lambda *_: 5, "gave int at compile(), expected an object with init() and step()"),
    "takes nothing": (lambda: 5, "TypeError: <lambda>() takes 0 positional arguments but "),
    "step fails": (steps(boom), "KeyError: 'boom' (test_broken_algorithms.py, line "),
    "gives nothing": (steps(lambda n: None), "gave NoneType at step(), expected the state and a list"),
    "gives five": (steps(lambda n: (n, 5)), "gave int, expected list"),
}
FIVES = steps(lambda n: step_result(n, 5))
CHIPS = "codebook codewords: expected a 2-D array of chips 0 and 1"
CASES: dict[tuple[str, str], tuple[Any, str]] = {
    **{
        ("framing", name): (make_algorithm(Uart, compile=how), text) for name, (how, text) in COMPILES.items()
    },
    **{
        ("detection", name): (make_algorithm(Detection, compile=how), text)
        for name, (how, text) in COMPILES.items()
    },
    ("framing", "gives fives"): (make_algorithm(Uart, compile=FIVES), "gave int, expected DecodedFrame"),
    ("detection", "gives fives"): (make_algorithm(Detection, compile=FIVES), "gave int, expected Region"),
    ("framing", "time is NaN"): (frames({"t_us": NAN}), "gave t_us = nan, expected a number from "),
    ("framing", "LLR is NaN"): (frames({"llr": np.full((1, 8), NAN)}), "gave llr of other values, expected"),
    ("framing", "symbol is none"): (frames({"symbols": np.array([256])}), "gave symbol 256, expected"),
    ("framing", "frame is none"): (frames({"frame": 20}), "gave frame = 20, expected a number from 0 to 19"),
    ("framing", "goes back"): (frames({"packet": 3}, {"packet": 1}), "gave frame 0 of packet 1 behind"),
    ("framing", "counts five"): (
        make_algorithm(Uart, compile=steps(step_result, 5)),
        "gave int, expected Mapping",
    ),
    ("framing", "counts frames"): (
        make_algorithm(Uart, compile=steps(step_result, {"frames": 5})),
        "gave 'frames' at counts(), expected another name",
    ),
    ("framing", "book fails"): (
        make_algorithm(Uart, codebook=boom),
        "KeyError: 'boom' (test_broken_algorithms.py, line ",
    ),
    ("framing", "book is five"): (
        make_algorithm(Uart, codebook=lambda *_: 5),
        "TypeError: gave int at codebook(),",
    ),
    ("modulation", "one word"): (words(LONE), "codebook codewords: 1 row, expected two or more; "),
    ("pilots", "odd"): (
        make_algorithm(WhPilots, preamble=lambda _: np.full(4, 2)),
        "codebook preamble: expected a 1-D array of chips 0 and 1",
    ),
    ("ranging", "unfinished"): (Unfinished, "TypeError: Can't instantiate abstract class Unfinished"),
    ("ranging", "no data"): (NoData, "TypeError: "),
    ("tracking", "nothing"): (
        make_algorithm(Tracking, compile=lambda self: None),
        "gave NoneType, expected Tracker; ",
    ),
}
for (_role, _id), (_class, _) in CASES.items():
    globals()[f"{_role} {_id}"] = _class


@pytest.fixture(autouse=True)
def _stranger(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stranger's package is installed."""
    load, stranger = (
        Registry.load,
        Brings(*(Algorithm(role, id, f"{HERE}:{role} {id}", 1, "broken") for role, id in CASES)),
    )
    monkeypatch.setattr(Registry, "load", lambda *plugins: load(stranger, *plugins))


@pytest.fixture(scope="module")
def lamp_raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tenth of a second of one LED."""
    raw = tmp_path_factory.mktemp("broken") / "lamp.raw"
    link = {"bar": LAMP, "air": AIR, "framing": {"id": "uart"}}
    simulate({"duration_s": 0.1, "motion": {"distance_m": 30.0}, "link": link}, 1).save(raw)
    return raw


def options(role: str, id: str) -> list[str]:
    settings = [f"{role}.id={id}"]
    if role in ("framing", "detection"):
        settings += [f"bar.{key}={value}" for key, value in LAMP.items()]
        settings += [f"air.{key}={value}" for key, value in AIR.items()]
        settings += ["detection.id=spots"] if role == "framing" else ["framing.id=uart"]
    elif role in ("modulation", "pilots"):
        settings += ["separation.id=edges", "decoding.id=edges"]
    return [part for one in settings for part in ("--set", one)]


@pytest.mark.parametrize(("role", "id"), CASES)
def test_it_is_one_line(role, id, evlcp, lamp_raw, demo_raw, tmp_path) -> None:
    raw = lamp_raw if role in ("framing", "detection") else demo_raw
    done = evlcp("receive", raw, "-o", tmp_path / "out", *options(role, id))
    assert done.code == 2, done.err
    assert done.err.startswith(f"evlcp: {role} algorithm '{id}': {CASES[role, id][1]}"), done.err
    assert done.err.count("\n") == 1
    assert f"try: evlcp check {role} {id}" in done.err
    assert "Traceback" not in done.err


def test_what_was_received_before_it_failed_is_kept(lamp_raw: Path, tmp_path: Path) -> None:
    """Packets that were given before the fault are in the files, whose summary gives the reason."""

    def gives(n: int) -> Any:
        return step_result(n, decoded_frame(float(n), packet=n - 8)) if n < 40 else boom()

    link = resolve({"bar": LAMP, "air": AIR, "framing": {"id": "uart"}, "detection": {"id": "whole"}})
    link = link.with_algorithm("framing", make_algorithm(Uart, compile=lambda *_: Steps(gives))(), id="mine")
    message = "framing algorithm 'mine': KeyError: 'boom'"
    with pytest.raises(PluginError, match=message):
        receive_to_folder(lamp_raw, tmp_path / "out", link)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "failed"
    assert summary["error"].startswith(message)
    assert 5 < len(rows_of(tmp_path / "out" / "frames.csv")) <= 32
