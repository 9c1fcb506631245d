"""Deliberately broken algorithms on the command line: one line that names them, and what was expected."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evlcp_uart.framing import Uart
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.hooks import Algorithm, hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Detection, Modulation, Pilots, Ranging, Tracking
from evlcp_sdk.simulated import simulate
from evlcp_sdk.values import DecodedFrame, SoftSymbols

Evlcp = Callable[..., Any]

LAMP = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
AIR = {"chip_rate_hz": 10_000.0, "frames_per_packet": 20}
HERE = __name__


def boom(*_: object) -> Any:
    raise KeyError("boom")


def heard(t_us: float, packet: int = 0, frame: int = 0, chip_us: float = 100.0, **soft: Any) -> DecodedFrame:
    given = {
        "symbols": np.array([65]),
        "llr": np.ones((1, 8), np.float32),
        "quality": 0.9,
    }
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


def at(state: int, *found: Any) -> Any:
    return state + 1, list(found)


NAN = float("nan")
COMPILES: dict[str, Any] = {
    "compile fails": boom,
    "compiles to five": lambda *_: 5,
    "takes nothing": lambda: 5,
    "step fails": lambda *_: Steps(boom),
    "gives nothing": lambda *_: Steps(lambda n: None),
    "gives five": lambda *_: Steps(lambda n: (n, 5)),
    "gives fives": lambda *_: Steps(lambda n: at(n, 5)),
}
FRAMINGS: dict[str, Any] = COMPILES | {
    "time is NaN": lambda *_: Steps(lambda n: at(n, heard(NAN))),
    "LLR is NaN": lambda *_: Steps(lambda n: at(n, heard(n, llr=np.full((1, 8), NAN)))),
    "LLR is int8": lambda *_: Steps(lambda n: at(n, heard(n, llr=np.ones((1, 8), np.int8)))),
    "LLR of another shape": lambda *_: Steps(lambda n: at(n, heard(n, llr=np.ones((2, 9))))),
    "symbol is none": lambda *_: Steps(lambda n: at(n, heard(n, symbols=np.array([256])))),
    "frame is none": lambda *_: Steps(lambda n: at(n, heard(n, frame=20))),
    "chip is negative": lambda *_: Steps(lambda n: at(n, heard(n, chip_us=-100.0))),
    "goes back": lambda *_: Steps(lambda n: at(n, heard(n, packet=3), heard(n, packet=1))),
    "counts five": lambda *_: Steps(at, 5),
    "counts words": lambda *_: Steps(at, {"words": "many"}),
}
BOOKS: dict[str, Any] = {
    "book fails": boom,
    "book is five": lambda *_: 5,
    "book of one": lambda *_: Codebook(
        "one", np.ones(2, np.uint8), np.empty((1, 0), np.uint8), np.array([[0, 1]], np.uint8)
    ),
}
WORDS: dict[str, Any] = {
    "words fail": boom,
    "words are none": lambda _: None,
    "words are floats": lambda _: np.eye(8) / 2,
    "words are NaN": lambda _: np.full((8, 4), NAN),
    "words are flat": lambda _: np.zeros(8, np.uint8),
    "words are alike": lambda _: np.array([[0, 1], [0, 1]], np.uint8),
    "one word": lambda _: np.array([[0, 1]], np.uint8),
}


class OddPilots(Pilots):
    """Its preamble has values of no chips."""

    def preamble(self) -> NDArray[np.uint8]:
        return np.full(4, 2, np.uint8)

    def codes(self, clusters: int) -> NDArray[np.uint8]:
        return np.eye(clusters, dtype=np.uint8)


@dataclass(frozen=True)
class PlainPilots(OddPilots):
    """Pilots."""


@dataclass(frozen=True)
class Unfinished(Ranging):
    """Has no `compile`."""


class NoData(Ranging):
    """Is no dataclass."""

    def compile(self, *_: object) -> Any:
        return boom


@dataclass(frozen=True)
class Refuses(NoData):
    """Fails when it is made."""

    def __post_init__(self) -> None:
        boom()


@dataclass(frozen=True)
class Late(NoData):
    """Fails at the first frame."""


@dataclass(frozen=True)
class NoTracker(Tracking):
    """Compiles to nothing."""

    def compile(self) -> Any:
        return None


def made(base: type, **methods: Any) -> Any:
    return dataclass(frozen=True)(type("Broken", (base,), methods | {"__doc__": "Broken."}))


CLASSES: dict[tuple[str, str], Any] = {
    **{("framing", name): made(Uart, compile=how) for name, how in FRAMINGS.items()},
    **{("framing", name): made(Uart, codebook=how) for name, how in BOOKS.items()},
    **{("detection", name): made(Detection, compile=how) for name, how in COMPILES.items()},
    **{("modulation", name): made(Modulation, codewords=how) for name, how in WORDS.items()},
    ("pilots", "odd"): PlainPilots,
    ("ranging", "unfinished"): Unfinished,
    ("ranging", "no data"): NoData,
    ("ranging", "refuses"): Refuses,
    ("ranging", "late"): Late,
    ("tracking", "nothing"): NoTracker,
}
for (_role, _id), _class in CLASSES.items():
    globals()[f"{_role} {_id}"] = _class

STEP_FAULTS = {
    "compile fails": "KeyError: 'boom' (test_broken_algorithms.py, line ",
    "compiles to five": "gave int at compile(), expected an object with init() and step()",
    "takes nothing": "TypeError: <lambda>() takes 0 positional arguments but ",
    "step fails": "KeyError: 'boom' (test_broken_algorithms.py, line ",
    "gives nothing": "gave NoneType at step(), expected the state and a list",
    "gives five": "gave int, expected list",
}
CHIPS = "codebook codewords: expected a 2-D array of chips 0 and 1"
SAYS: dict[tuple[str, str], str] = {
    **{("framing", name): says for name, says in STEP_FAULTS.items()},
    **{("detection", name): says for name, says in STEP_FAULTS.items()},
    ("framing", "gives fives"): "gave int, expected DecodedFrame",
    ("detection", "gives fives"): "gave int, expected Region",
    ("framing", "time is NaN"): "gave t_us = nan, expected a number from ",
    ("framing", "LLR is NaN"): "gave llr of other values, expected finite ones",
    ("framing", "LLR is int8"): "gave llr of int8, expected floats",
    ("framing", "LLR of another shape"): "gave llr of shape (2, 9), expected (1, 8)",
    ("framing", "symbol is none"): "gave symbol 256, expected 0 to 255, or -1 for one not given",
    ("framing", "frame is none"): "gave frame = 20, expected a number from 0 to 19",
    ("framing", "chip is negative"): "gave chip_us = -100.0, expected a number from 50 to 200",
    ("framing", "goes back"): "gave frame 0 of packet 1 behind frame 0 of packet 3, expected frames in order",
    ("framing", "counts five"): "gave int, expected Mapping",
    ("framing", "counts words"): "gave str for 'words' at counts(), expected whole numbers",
    ("framing", "book fails"): "KeyError: 'boom'; ",
    ("framing", "book is five"): "TypeError: gave int at codebook(), expected a Codebook; ",
    ("framing", "book of one"): "ValueError: gave 1 codeword, expected two or more; ",
    ("modulation", "words fail"): "KeyError: 'boom'; ",
    ("modulation", "words are none"): CHIPS,
    ("modulation", "words are floats"): CHIPS,
    ("modulation", "words are NaN"): CHIPS,
    ("modulation", "words are flat"): CHIPS,
    ("modulation", "words are alike"): "codebook codewords: rows 0 and 1 are equal",
    ("modulation", "one word"): "ValueError: gave 1 codeword, expected two or more; ",
    ("pilots", "odd"): "codebook preamble: expected a 1-D array of chips 0 and 1",
    ("ranging", "unfinished"): "TypeError: Can't instantiate abstract class Unfinished",
    ("ranging", "no data"): "TypeError: ",
    ("ranging", "refuses"): "KeyError: 'boom'; ",
    ("ranging", "late"): "KeyError: 'boom' (test_broken_algorithms.py, line ",
    ("tracking", "nothing"): "gave NoneType, expected Tracker; ",
}


class Stranger:
    """A package of broken algorithms."""

    @hookimpl
    def evlcp_algorithms(self) -> list[Algorithm]:
        return [Algorithm(role, id, f"{HERE}:{role} {id}", 1, "broken") for role, id in CLASSES]


@pytest.fixture(autouse=True)
def _stranger(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stranger's package is installed."""
    load, stranger = Registry.load, Stranger()
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


@pytest.mark.parametrize(("role", "id"), SAYS)
def test_it_is_one_line(
    role: str, id: str, evlcp: Evlcp, lamp_raw: Path, demo_raw: Path, tmp_path: Path
) -> None:
    raw = lamp_raw if role in ("framing", "detection") else demo_raw
    done = evlcp("receive", raw, "-o", tmp_path / "out", *options(role, id))
    assert done.code == 2, done.err
    assert done.err.startswith(f"evlcp: {role} algorithm '{id}': {SAYS[role, id]}"), done.err
    assert done.err.count("\n") == 1
    assert f"try: evlcp check {role} {id}" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(("role", "id"), list(SAYS)[::4])
def test_check_finds_it(role: str, id: str, evlcp: Evlcp) -> None:
    done = evlcp("check", role, id)
    assert done.code in (1, 2)
    assert "failed" in done.out or done.err.startswith(f"evlcp: {role} algorithm '{id}': "), done.err
    assert done.err.count("\n") <= 1
    # It has just been tried.
    assert f"evlcp check {role} {id}" not in done.out + done.err


def test_what_was_received_before_it_failed_is_kept(evlcp: Evlcp, lamp_raw: Path, tmp_path: Path) -> None:
    """Packets that were given before the fault are in the files, whose summary says why they end."""
    from evlcp_sdk.errors import PluginError
    from evlcp_sdk.link.resolve import resolve
    from evlcp_sdk.run import receive, receive_to_folder

    def gives(n: int) -> Any:
        return at(n, heard(float(n), packet=n - 8)) if n < 40 else boom()

    link = resolve({"bar": LAMP, "air": AIR, "framing": {"id": "uart"}, "detection": {"id": "whole"}})
    link = link.with_algorithm("framing", made(Uart, compile=lambda *_: Steps(gives))(), id="mine")
    with pytest.raises(PluginError, match="framing algorithm 'mine': KeyError: 'boom'"):
        receive_to_folder(lamp_raw, tmp_path / "out", link)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "failed"
    assert summary["error"].startswith("framing algorithm 'mine': KeyError: 'boom'")
    rows = (tmp_path / "out" / "frames.csv").read_text().splitlines()
    assert 5 < len(rows) - 1 <= 32
    reception, packets = receive(lamp_raw, link), []
    with pytest.raises(PluginError, match="framing algorithm 'mine': KeyError: 'boom'"):
        packets += reception
    assert sum(len(packet.frames) for packet in packets) == len(rows) - 1
