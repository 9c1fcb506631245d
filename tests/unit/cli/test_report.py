"""The report: what the page holds, that it needs no network, and that a browser draws it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from evlcp_sdk.cli.report import to_markdown
from evlcp_sdk.study.collect import collect_results
from evlcp_sdk.study.comparison import compare_links
from evlcp_sdk.study.jobs import Inline
from evlcp_sdk.study.plan import Case, Job, Plan
from evlcp_sdk.study.report import POSITION_HEAD, draw_charts, position_rows, render_campaign
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.summary import PAPER, Series, Summary, compare_with_paper, summarize
from evlcp_sdk.study.tally import Statistics, Tally
from tests.unit.study.browser import CHROMIUM, Browser
from tests.unit.study.fake import run_fake

TWO = "two clusters <!--<script>"
"""In a script element, such a name would keep its end tag from ending it."""

FAST = {"motion": {"speed_mps": 30 / 3.6}}
CHARTS = ("ber", "rmse", "gross", "found", "histogram")


def plan_of_two_methods() -> Plan:
    """Drives at two speeds through five segments, received with 16 clusters and with two."""
    bar = {"rows": 96, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
    methods = {"16 clusters": {}, TWO: {"clusters": [1, 14]}}
    return Plan(
        "two methods </script>",
        tuple(
            Case({"speed_kmh": v, "distance_m": 30.0 + 10 * n}, {"n": n}, {"n": n, "motion": motion})
            for v, motion in ((20, {"speed_mps": 20 / 3.6}), (30, {"speed_mps": 30 / 3.6}))
            for n in range(5)
        ),
        tuple(
            Case({"variant": name}, i, {"table": {"bar": bar, "ranging": ranging}, "digest": "d" * 64})
            for i, (name, ranging) in enumerate(methods.items())
        ),
        (0, 1),
        merge=("scene.distance_m",),
        environment={"evlcp-sdk": "0"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    with Store(tmp_path_factory.mktemp("report") / "a.sqlite", create=True) as store:
        collect_results(plan_of_two_methods(), store, Inline(), run_fake)
        return summarize(store)


def test_points_that_differ_in_distance_only_are_one_series(summary: Summary) -> None:
    assert [s.name for s in summary.series] == [
        "20 km/h, 16 clusters",
        f"20 km/h, {TWO}",
        "30 km/h, 16 clusters",
        f"30 km/h, {TWO}",
    ]
    for series in summary.series:
        assert [*series.statistics.segments] == [30, 40, 50, 60, 70]
        assert series.statistics.tasks == 10
    assert [s.clusters for s in summary.series] == [16, 2, 16, 2]
    assert [s.speed_kmh for s in summary.series] == [20, 20, 30, 30]


def test_the_paper_is_held_beside_the_series_it_speaks_of(summary: Summary) -> None:
    found = compare_with_paper(summary.series)
    by_name = {(c.reference.measure, c.reference.from_m, c.reference.clusters): c.series for c in found}
    assert by_name["rmse_m", 30, 16].startswith("30 km/h, 16")
    assert by_name["rmse_m", 30, 2].startswith("30 km/h, two")
    assert sum(c.reference.measure == "ber" for c in found) == 2
    # Beside a bound stands the worst segment; the scenes are the harder, the farther.
    assert {c.from_m for c in found if c.reference.measure == "ber"} == {70}
    ours = Series({}, FAST, summary.series[0].link, ())
    assert compare_with_paper([ours]) == []


def test_a_smaller_figure_is_better_and_a_kept_bound_agrees(summary: Summary) -> None:
    link = summary.series[0].link
    for reference in PAPER:
        if reference.measure != "rmse_m" or reference.clusters != 16:
            continue
        for factor, verdict in (
            (1.4, "worse"),
            (0.99, "agrees"),
            (0.5, "agrees" if reference.bound else "better"),
            (1.25, "worse" if reference.bound else "agrees"),
        ):
            tally = Tally.of_distance(reference.value * factor)
            at = Statistics.of([(reference.from_m, tally)], tasks=1)
            (one,) = compare_with_paper([Series({}, FAST, link, (at,))], [reference])
            assert one.verdict == verdict, (reference, factor)


def test_a_limit_stands_above_the_paper_for_no_want_of_data(summary: Summary) -> None:
    """3.7 / 400 distances are a limit above the paper's .004, 3.7 / 1200 are none."""
    at = Statistics.of([(m, Tally.of_distance(0.0)) for m in (30, 40, 50) for _ in range(400)], tasks=1)
    series = Series({"scene.speed_kmh": 30}, FAST, summary.series[0].link, (at,))
    (gross,) = (one for one in draw_charts(replace(summary, series=(series,))) if one.id == "gross")
    (shown,) = [text.splitlines()[1] for *_, text, _ in gross.labels if text.startswith(series.name)]
    assert shown.startswith("30 to 60 m: below 0.0031")


def test_the_page_tells_everything(summary: Summary) -> None:
    text = render_campaign(summary)
    assert summary.plan.digest in text
    assert "<h1>two methods &lt;/script&gt;</h1>" in text
    verdicts = [one.verdict for one in compare_with_paper(summary.series)]
    assert text.count('<span class="no">worse</span>') == verdicts.count("worse")
    assert text.count('<span class="yes">better</span>') == verdicts.count("better")
    assert "arXiv 2510.17203" in text
    assert "d" * 64 in text


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_browser_draws_it_and_hover_works(summary: Summary, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(render_campaign(summary), encoding="utf-8")
    (tmp_path / "compare.html").write_text(compare_links(summary).to_html(), encoding="utf-8")
    with Browser(tmp_path / "profile") as browser:
        browser.open(tmp_path / "report.html")
        drawn = browser.value(
            "Object.fromEntries([...document.querySelectorAll('.plot')].map(e =>"
            " [e.id, e.querySelectorAll('.legend button').length]))"
        )
        assert set(drawn) == set(CHARTS)
        assert drawn["histogram"] == 4
        assert drawn["rmse"] > 4, "the paper's figures are missing"
        assert browser.value("document.querySelectorAll('table tr').length") > 20
        plots = browser.value("plots")
        for width in (1280, 390):
            for dark in (False, True):
                browser.dress(width, dark=dark)
                for chart in CHARTS:
                    area = f"document.querySelector('#{chart} .area')"
                    room = browser.value(f"{area}.clientWidth")
                    assert 0.7 * width - 200 < room <= width - 20, f"{chart}: of {width} px"
                    ink = browser.value(f"getComputedStyle({area}.querySelector('.x')).color")
                    assert (int(re.findall(r"\d+", ink)[0]) > 128) is dark, f"{chart}: not for this scheme"
                # What is told of the last points of wide charts stays within those that become narrow.
                assert browser.fits()
                for chart in CHARTS if width == 1280 else ():
                    reported = browser.hover(chart, max(plots[chart]))
                    assert "km/h" in reported, f"{chart}: nothing is told where the pointer is"
        drawn_lines = (
            "[...document.querySelectorAll('#rmse .area path')].filter(e => e.checkVisibility()).length"
        )
        before = browser.value(drawn_lines)
        browser.value("document.querySelector('#rmse button').click()")
        assert browser.value(drawn_lines) < before
        assert browser.value("document.querySelectorAll('#rmse button[aria-pressed=false]').length") == 1
        browser.value("document.querySelector('#rmse button').click()")
        assert browser.value(drawn_lines) == before
        assert {url.split(":")[0] for url in browser.requests} <= {"file", "data", "blob"}
        assert browser.faults == []
        browser.open(tmp_path / "compare.html")
        for width in (1280, 390):
            browser.dress(width, dark=True)
            assert browser.fits()


def test_what_became_of_positions_is_a_table_of_its_own(summary: Summary, tmp_path: Path) -> None:
    assert position_rows(summary) == []
    assert "<h2>Positions</h2>" not in render_campaign(summary)
    scenes = tuple(Case({"variant": v}, v, v) for v in ("right", "off"))
    plan = Plan("p", scenes, (Case({}, 0, {}),), (0,))
    fixes = [Tally.of_fix(0.1, 2.0, protected=True), Tally.of_fix(0.3, 20.0, excluded=True)]
    tallies = {
        "right": [*fixes, Tally.of_track_point(0.2, 3.0, 0.1, 6.0), Tally(messages_sent=4, messages_found=3)],
        "off": [Tally(fixes_refused=3, fixes_contradicted=2)],
    }

    def run(job: Job) -> list[tuple[str, Statistics]]:
        return [(task.id, Statistics.of((40, t) for t in tallies[task.scene])) for task in job.tasks]

    with Store(tmp_path / "p.sqlite", create=True) as store:
        collect_results(plan, store, Inline(), run)
        found = summarize(store)
    right, off = position_rows(found)
    assert len(right) == len(off) == len(POSITION_HEAD)
    assert right[1:8] == ("2 of 2", "0", "100.0%", "1", "0.105, 0.305", "11", "1")
    assert right[8:] == ("1", "1", "0", "0.200", "3", "0.100", "6")
    assert off[1:5] == ("0 of 3", "2", "0.0%", "0")
    assert "<h2>Positions</h2>" in render_campaign(found)
    assert "| right | 2 of 2 | 0 | 100.0% |" in to_markdown(found)
    assert "| 3 of 4 | 0 | 2 of 2 |" in to_markdown(found)
