"""Results files that somebody else wrote: views, damaged pages, mutants; a report changes nothing."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk.cli.report import print_tables, to_markdown
from evlcp_sdk.errors import InputError
from evlcp_sdk.study.collect import collect_results
from evlcp_sdk.study.comparison import compare_links
from evlcp_sdk.study.jobs import Inline
from evlcp_sdk.study.plan import Case, Plan
from evlcp_sdk.study.report import draw_charts, render_campaign
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.summary import Summary, summarize
from tests.unit.mutants import mutants, refusal
from tests.unit.report.test_pages import HOSTILE, Elements
from tests.unit.study.fake import fake_plan, run_fake


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A finished campaign, nothing of it left in a log."""
    path = tmp_path_factory.mktemp("finished") / "a.sqlite"
    with Store(path, create=True) as store:
        collect_results(fake_plan(scenes=2, seeds=2), store, Inline(), run_fake)
    return path.read_bytes()


@pytest.fixture
def results(tmp_path: Path, finished: bytes) -> Path:
    path = tmp_path / "a.sqlite"
    path.write_bytes(finished)
    return path


def change(path: Path, statement: str, *rows: tuple[Any, ...]) -> list[Any]:
    """Run a statement, with each of some rows, on a file that nobody has open; what it gives."""
    with closing(sqlite3.connect(path)) as base:
        found = [row for given in rows or [()] for row in base.execute(statement, given)]
        base.commit()
        base.execute("PRAGMA journal_mode = DELETE")
    return found


def read(path: Path) -> Summary:
    with Store(path) as store:
        return summarize(store)


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


@pytest.mark.parametrize(
    "statements",
    [
        ("DROP TABLE plan", f"CREATE VIEW plan AS {ENDLESS} SELECT 'a' AS name, max(i) AS body FROM n"),
        ("DROP TABLE result", f"CREATE VIEW result AS {ENDLESS} SELECT i AS task, 'x' AS statistics FROM n"),
        ("CREATE TRIGGER t AFTER INSERT ON result BEGIN DELETE FROM plan; END",),
        ("DROP TABLE plan",),
    ],
)
def test_a_file_of_other_tables_is_refused_at_once(results: Path, statements: tuple[str, ...]) -> None:
    for statement in statements:
        change(results, statement)
    for create in (False, True):
        with pytest.raises(InputError, match=r"a\.sqlite: not a results file of this SDK: other tables"):
            Store(results, create=create)


def test_a_page_that_is_its_own_child_is_damage(results: Path) -> None:
    rows = [(f"{task:064x}", "{}" * 300) for task in range(3000)]
    change(results, "INSERT INTO result (task, statistics) VALUES (?, ?)", *rows)
    ((root,),) = change(results, "SELECT rootpage FROM sqlite_master WHERE name = 'result'")
    ((size,),) = change(results, "PRAGMA page_size")
    data, at = bytearray(results.read_bytes()), (root - 1) * size
    assert data[at] == 2, "no page with children"
    data[at + 8 : at + 12] = root.to_bytes(4, "big")
    results.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.sqlite: damaged"):
        read(results)


def test_a_report_changes_nothing(results: Path) -> None:
    before = results.read_bytes()
    with Store(results) as store:
        assert sorted(results.parent.iterdir()) == [results]
        summarize(store)
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            store._base.execute("DELETE FROM result")
    assert sorted(results.parent.iterdir()) == [results]
    assert results.read_bytes() == before


def test_what_still_runs_is_read_from_its_log(results: Path) -> None:
    with Store(results, create=True) as writer:
        collect_results(fake_plan(scenes=3, seeds=3), writer, Inline(), run_fake)
        assert Path(f"{results}-wal").stat().st_size
        assert read(results).done == 18
    assert read(results).done == 18


def draw_page(summary: Summary) -> Elements:
    """Everything that is told of a summary; its page."""
    json.dumps(summary.to_dict(), allow_nan=False)
    print_tables(summary)
    to_markdown(summary)
    draw_charts(summary)
    compared = compare_links(summary)
    compared.to_json()
    compared.to_csv()
    assert_plain(Elements(compared.to_html()))
    return assert_plain(Elements(render_campaign(summary)))


def assert_plain(found: Elements) -> Elements:
    assert not {tag for tag, _ in found.tags} & {"img", "iframe", "object", "embed", "base", "form"}
    assert not [a for _, attrs in found.tags for a in attrs if a.startswith("on") or a == "src"]
    assert not [s for s in found.scripts if s.startswith("document.title")]
    assert "'unsafe-inline'" not in found.policy["script-src"]
    return found


def keep_plan(path: Path, plan: str) -> None:
    change(path, "UPDATE plan SET body = ?", (plan,))


@pytest.fixture
def plan(results: Path) -> dict[str, Any]:
    """What the file has of the plan."""
    ((body,),) = change(results, "SELECT body FROM plan")
    return json.loads(body)


@pytest.mark.parametrize("changed", ["plan", "statistics"])
def test_what_was_changed_is_taken_or_refused_in_one_line(results, plan, changed) -> None:
    table = {"bar": {"rows": 96, "cluster_rows": 6, "columns": 1, "cluster_columns": 1}}
    plan["links"][0]["identity"] = table | {"digest": "d" * 64, "table": {"ranging": {}, **table}}
    plan["scenes"][0]["identity"] = {"motion": {"speed_mps": 8.0}}
    keep_plan(results, json.dumps(plan))
    task, text = change(results, "SELECT task, statistics FROM result")[0]
    refused = 0
    for mutant, what in mutants(plan if changed == "plan" else json.loads(text), 10, seed=3):
        if changed == "plan":
            keep_plan(results, json.dumps(mutant))
        else:
            change(results, "UPDATE result SET statistics = ? WHERE task = ?", (json.dumps(mutant), task))
        line = refusal(lambda: draw_page(read(results)))
        if line is not None:
            refused += 1
            assert line.startswith(f"{results}: "), what
            assert len(line.splitlines()) == 1, what
    assert 2 < refused < 10


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"seeds": [HOSTILE]}, "seeds.0 = "),
        *(({"seeds": []}, "seeds"), ({"scenes": {}}, "scenes"), ({"rule": None}, "rule")),
        *((text, "") for text in ("{}", "3", "[" * 200_000, "9" * 5000, '{"a": NaN}')),
    ],
    ids=lambda value: str(value)[:20],
)
def test_what_is_no_plan_is_named_in_one_line(results, plan, body, message) -> None:
    keep_plan(results, body if isinstance(body, str) else json.dumps(plan | body))
    line = refusal(lambda: read(results)) or ""
    assert "a.sqlite: damaged, or no results file of evlcp sweep" in line
    assert message in line
    assert len(line.splitlines()) == 1
    assert len(line) < 500


def test_hostile_names_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    identity = {"n": 0, HOSTILE: [HOSTILE], "digest": HOSTILE, "table": {HOSTILE: HOSTILE}}
    plan = Plan(
        HOSTILE,
        (Case({HOSTILE: HOSTILE, "variant": "[/]$\\frac$"}, {"n": 0}, identity),),
        (Case({"variant": HOSTILE}, 0, identity),),
        (0, 1),
        environment={HOSTILE: HOSTILE},
    )
    with Store(tmp_path / "a.sqlite", create=True) as store:
        collect_results(plan, store, Inline(), run_fake)
    found = draw_page(read(tmp_path / "a.sqlite"))
    assert found.text.count(HOSTILE) > 8
    assert HOSTILE in capsys.readouterr().out
