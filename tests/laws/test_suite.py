"""The suite as users meet it: `check`, excuses, the decorator, `evlcp check`."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from evlcp_centroid.ranging import CentroidRanging

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Filter, Ranging, Tracker, Tracking
from evlcp_sdk.testing import check, laws_of
from evlcp_sdk.testing.law import Subject
from evlcp_sdk.testing.trees import difference

Evlcp = Callable[..., Any]

AUTHOR = '''
from dataclasses import dataclass, replace

from evlcp_centroid.ranging import CentroidRanging
from evlcp_sdk.testing import conformance


@dataclass(frozen=True)
class Biased(CentroidRanging):
    """One percent too far."""

    def compile(self, camera, bar, codebook):
        measure = super().compile(camera, bar, codebook)

        def biased(view):
            found = measure(view)
            return replace(found, distance_m=1.01 * found.distance_m)

        return biased


@conformance("ranging", CentroidRanging(), CentroidRanging(skip_outer=2))
def test_good(check):
    check()


@conformance("ranging", Biased())
def test_broken(check):
    check()


@conformance("ranging", Biased(), excuses={"exact": "the lens is not calibrated yet"})
def test_excused(check):
    check()


@conformance("ranging", CentroidRanging(), excuses={"exact": "needless"})
def test_needless(check):
    check()
'''


def test_the_decorator_makes_one_test_a_law(tmp_path: Path) -> None:
    (tmp_path / "test_author.py").write_text(AUTHOR)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:cacheprovider", "test_author.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    n = len(laws_of("ranging"))
    assert f"2 failed, {5 * n - 3} passed, 1 xfailed" in run.stdout
    assert "PASSED test_author.py::test_good[CentroidRanging-1-clean-link]" in run.stdout
    assert "FAILED test_author.py::test_broken[Biased-exact]" in run.stdout
    assert "expected 108.025 m within 0.1% for clusters exactly 4 px apart, got 109.105 m" in run.stdout
    assert "XFAIL test_author.py::test_excused[Biased-exact] - the lens is not calibrated yet" in run.stdout
    assert "[XPASS(strict)] needless" in run.stdout


def test_excuses_are_strict() -> None:
    told = {"monotone": "a reason"}
    found = {o.law.name: o for o in check("ranging", CentroidRanging(), told)}
    assert found["monotone"].status == "failed"
    assert found["monotone"].detail == "excused (a reason), but it holds: drop the excuse"
    assert {o.status for name, o in found.items() if name != "monotone"} == {"ok"}


def test_what_is_refused_is_skipped_but_for_one_law() -> None:
    class Refusing(Ranging):
        def compile(self, *given: Any) -> Any:
            raise ConfigError("a panel only")

    found = {o.law.name: o for o in check("ranging", Refusing(), {"exact": "because"})}
    assert found["compiles"].status == "failed"
    assert found["monotone"].status == "skipped"
    assert found["monotone"].detail == "refused: a panel only"
    assert found["exact"].detail == "excused (because), but the law does not apply: refused: a panel only"


@pytest.mark.parametrize(
    ("role", "excuses", "said"),
    [
        ("rangin", {}, "no role named 'rangin'"),
        ("ranging", {"exakt": "why"}, "no ranging law named 'exakt'"),
        ("ranging", {"exact": " "}, "expected a reason"),
    ],
)
def test_wrong_names_are_refused(role: str, excuses: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check(role, CentroidRanging(), excuses)


def test_the_receiver_begins_a_filter_with_its_init() -> None:
    class Latest(Filter):
        def init(self) -> Any:
            return ()

        def predict(self, state: Any, t_us: float) -> Any:
            return (state[0], 0.1) if state else None

        def step(self, state: Any, t_us: float, value: Any, sigma: float) -> Any:
            assert state == () or len(state) == 1
            return (value.copy(),), value.copy(), sigma

    @dataclass(frozen=True)
    class Latests(Tracking):
        def compile(self) -> Tracker:
            return Tracker(position=Latest(), distance=Latest())

    law = next(law for law in laws_of("tracking") if law.name == "clean-link")
    law.hold(Subject("tracking", Latests()))


def test_difference_says_where() -> None:
    from evlcp_sdk.values import Range

    a = Range(1.0, float("nan"), 2)
    assert difference([a], [a]) is None
    assert difference([replace(a, pairs=3)], [a]) == "result[0].pairs: 3, not 2"
    assert difference([a, a], [a]) == "result: 2 entries, not 1"


def test_the_command_says_one_line_a_law(evlcp: Evlcp) -> None:
    done = evlcp("check", "ranging", "centroid")
    *lines, last = done.out.splitlines()
    assert done.code == 0
    assert [line.split()[:2] for line in lines] == [["ok", law.name] for law in laws_of("ranging")]
    assert last.startswith("ranging 'centroid' of evlcp-sdk")
    assert last.endswith(f"{len(lines)} ok")


def test_the_command_fails_with_what_was_expected(evlcp: Evlcp) -> None:
    given = ("--set", "min_clusters=14", "--set", "skip_outer=2")
    done = evlcp("check", "ranging", "centroid", *given)
    assert done.code == 1
    assert "failed   exact           expected 108.025 m within 0.1%" in done.out
    done = evlcp("check", "ranging", "centroid", *given, "--json")
    table = json.loads(done.out)
    assert done.code == 1
    assert table["parameters"] == {"skip_outer": 2, "min_clusters": 14}
    assert table["failed"] == sum(law["status"] == "failed" for law in table["laws"]) > 0
    assert {"law", "says", "status", "detail"} == set(table["laws"][0])


def test_the_command_takes_excuses(evlcp: Evlcp) -> None:
    done = evlcp("check", "ranging", "centroid", "--excuse", "exact=never mind")
    assert done.code == 1
    assert "excused (never mind), but it holds: drop the excuse" in done.out
    done = evlcp("check", "tracking", "none")
    assert done.code == 0
    assert "skipped  straight-line   leaves every quantity as measured" in done.out


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("ranging", "pco"), "did you mean 'poc'?"),
        (("rangin", "poc"), "no role named 'rangin' (known: pilots,"),
        (("ranging", "poc", "--set", "foo=3"), "ranging.foo = 3: unknown key"),
        (("ranging", "poc", "--excuse", "exact"), "expected LAW=REASON"),
        (("ranging", "poc", "--excuse", "exakt=no"), "no ranging law named 'exakt'"),
    ],
)
def test_what_is_unknown_ends_with_2(evlcp: Evlcp, given: tuple[str, ...], said: str) -> None:
    done = evlcp("check", *given)
    assert done.code == 2
    assert said in done.err
    assert not done.out
