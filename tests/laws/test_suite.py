"""The suite as users meet it: `check`, excuses, the decorator, `evlcp check`."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
from evlcp_centroid.ranging import CentroidRanging

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.roles import ROLES, Ranging
from evlcp_sdk.testing import LawError, check, conformance, laws_of, suite
from evlcp_sdk.testing.law import Law, Subject, Verdict
from evlcp_sdk.testing.links import LINK

Evlcp = Callable[..., Any]


@dataclass(frozen=True)
class Biased(CentroidRanging):
    """One percent too far."""

    def compile(self, camera, bar, codebook):
        measure = super().compile(camera, bar, codebook)

        def biased(view):
            found = measure(view)
            return replace(found, distance_m=1.01 * found.distance_m)

        return biased


def exact(algorithm, excuses=None):
    """The case of a law, of those that the decorator makes."""
    name, cases = conformance("ranging", algorithm, excuses=excuses).mark.args
    by_id = {case.id: case.values[0] for case in cases}
    assert name == "check"
    assert [*by_id] == [f"{type(algorithm).__name__}-{law.name}" for law in laws_of("ranging")]
    return by_id[f"{type(algorithm).__name__}-exact"]


def test_the_decorator_makes_one_test_a_law():
    """As the tests of the packages in examples/ use it."""
    exact(CentroidRanging())()
    with pytest.raises(
        LawError, match=r"108\.025 m within 0\.1% for clusters exactly 4 px apart, got 109\.105"
    ):
        exact(Biased())()
    with pytest.raises(pytest.xfail.Exception, match="the lens is not calibrated yet"):
        exact(Biased(), {"exact": "the lens is not calibrated yet"})()
    with pytest.raises(LawError, match=r"excused \(needless\), but it holds: drop the excuse"):
        exact(CentroidRanging(), {"exact": "needless"})()
    with pytest.raises(LawError, match="expected no exception, got SystemExit: 3"):
        Law("ends", "does not exit", lambda _: sys.exit(3)).apply(Subject("ranging", CentroidRanging()))
    nothing = load_link(overrides=["tracking.id=none"]).algorithm("tracking")
    cases = conformance("tracking", nothing, nothing).mark.args[1]
    (line,) = (case for case in cases if case.id.endswith("-1-straight-line"))
    with pytest.raises(pytest.skip.Exception, match="leaves every quantity as measured"):
        line.values[0]()


def test_what_is_refused_is_skipped_but_for_one_law():
    class Refusing(Ranging):
        def compile(self, *given):
            raise ConfigError("a panel only")

    found = {o.law.name: o for o in check("ranging", Refusing(), {"exact": "because"})}
    assert found["compiles"].status == "failed"
    assert found["monotone"].status == "skipped"
    assert found["monotone"].detail == "refused: a panel only"
    assert found["exact"].detail == "excused (because), but the law does not apply: refused: a panel only"


def test_the_command_says_one_line_a_law(evlcp):
    done = evlcp("check", "ranging", "centroid", "--excuse", "exact=never mind")
    *lines, last = done.out.splitlines()
    assert done.code == 1
    assert "excused (never mind), but it holds: drop the excuse" in done.out
    status = [("failed" if law.name == "exact" else "ok", law.name) for law in laws_of("ranging")]
    assert [tuple(line.split()[:2]) for line in lines] == status
    assert last.startswith("ranging 'centroid' of evlcp-sdk")
    assert last.endswith(f"{len(lines) - 1} ok, 1 failed")
    done = evlcp("check", "tracking", "none")
    assert done.code == 0
    assert "skipped  straight-line       leaves every quantity as measured" in done.out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("rangin", "poc"), "no role named 'rangin' (known: detection,"),
        (("ranging", "poc", "--set", "foo=3"), "ranging.foo = 3: unknown key"),
        (("ranging", "poc", "--set", "foo"), "--set foo: expected KEY=VALUE or TABLE.KEY=VALUE"),
        (("ranging", "poc", "--set", "ranging.id=none"), "the algorithm is ranging poc, as given"),
        (("ranging", "poc", "--excuse", "exact"), "expected LAW=REASON"),
        (("ranging",), "check ranging: expected ROLE and ID, or neither for a whole link"),
        (("--excuse", "exact=no"), "--excuse: expected ROLE and ID"),
        (("ranging", "poc", "--excuse", "exakt=no"), "no ranging law named 'exakt'"),
    ],
)
def test_what_is_unknown_ends_with_2(evlcp, given, message):
    done = evlcp("check", *given)
    assert done.code == 2
    assert message in done.err
    assert not done.out


def test_a_whole_link(evlcp, monkeypatch):
    shown = []

    def hold(law, subject, _):
        shown.append((subject.role, law))
        bad = (subject.role, law.name) == ("decoding", "inverts")
        return Verdict(law, "failed" if bad else "ok", "symbol 3, got 4" if bad else "")

    monkeypatch.setattr(suite, "apply_law", hold)
    done = evlcp("check", "--set", "modulation.id=wh8")
    assert done.code == 1
    assert "modulation 'wh8'" in done.out
    assert "failed   inverts             symbol 3, got 4" in done.out
    assert {role for role, _ in shown} == set(ROLES)
    # Those of the link once only.
    assert [law for _, law in shown if law in LINK] == list(LINK)
    table = json.loads(evlcp("check", "--set", "modulation.id=wh8", "--json").out)
    assert (table["failed"], len(table["laws"])) == (1, len(shown) // 2)
    assert {law["id"] for law in table["laws"] if law["role"] == "link"} == {None}
    # Another framing, with a bar that suits it.
    assert "framing 'uart' of evlcp-sdk" in evlcp("check", "framing", "uart").out


@dataclass(frozen=True)
class Crashing(Ranging):
    """A stranger's ranging with a fault."""

    def compile(self, camera, bar, codebook):
        def measure(view):
            raise KeyError("cluster")

        return measure


def test_a_fault_is_blamed_on_the_algorithm_under_test_and_where_it_was():
    found = {o.law.name: o for o in check("ranging", Crashing())}
    for law in ("clean-link", "sparse-pilots"):
        assert found[law].status == "failed"
        assert "ranging algorithm 'Crashing': KeyError: 'cluster'" in found[law].detail
        assert "poc" not in found[law].detail
    fault = found["exact"].fault
    assert fault is not None
    assert isinstance(fault.__cause__, KeyError)


def test_a_law_sees_the_link_that_it_is_given():
    panel = load_link(
        overrides=["bar.rows=16", "bar.columns=16", "bar.cluster_rows=4", "bar.cluster_columns=4"]
    )
    found = {o.law.name: o for o in check("ranging", CentroidRanging(), link=panel)}
    assert found["compiles"].status == "ok"
    assert found["exact"].status == "skipped"
    assert found["exact"].detail == "the ideal images of this law show one column of two clusters or more"
    short = load_link(overrides=["bar.rows=24"])
    found = {o.law.name: o for o in check("ranging", CentroidRanging(), link=short)}
    assert found["compiles"].status == "failed"
    assert "the link's camera, bar and codebook to do, got: ranging 'centroid' uses 2 of 4" in (
        found["compiles"].detail
    )


def test_the_command_checks_on_any_link(evlcp, tmp_path):
    file = tmp_path / "link.toml"
    file.write_text("[bar]\nrows = 24\n[ranging]\nid = 'joint-scale'\nmin_boundaries = 3\n")
    # A name without a table, or with the role's, is a parameter of the algorithm; others are the link's.
    given = ("--set", "skip_outer=0", "--set", "ranging.min_clusters=3", "--set", "air.chip_rate_hz=5000.0")
    done = evlcp("check", "ranging", "centroid", "-c", file, *given, "--json")
    table = json.loads(done.out)
    assert done.code == table["failed"] == 0
    assert table["parameters"] == {"skip_outer": 0, "min_clusters": 3}
    settings = [f"ranging.{key}" for key in ("id=centroid", "skip_outer=0", "min_clusters=3")]
    wanted = load_link(overrides=["bar.rows=24", "air.chip_rate_hz=5000.0", *settings])
    assert table["link"] == wanted.digest
    # The parameters that the file gives the algorithm are kept.
    table = json.loads(evlcp("check", "ranging", "joint-scale", "-c", file, "--json").out)
    assert table["parameters"]["min_boundaries"] == 3
    assert table["failed"] == 0
