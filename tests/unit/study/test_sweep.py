"""`evlcp sweep` and `evlcp report` from a campaign file to figures, with real light."""

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from evlcp_sdk.cli.demo import demo_campaign
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.sim.scene import links_of
from evlcp_sdk.study.jobs import Inline
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.summary import summarize
from evlcp_sdk.study.task import plan_campaign, run_job
from tests.conftest import ROOT

CAMPAIGN = """
[campaign]
name = "short"
seeds = 1

[scene]
base = "drive-30kmh"
set = { duration_s = 0.05 }

[scene.grid]
motion.distance_m = [95.0, 85.0]

[link.variants]
"16 clusters" = {}
"two clusters" = { ranging.id = "poc", ranging.clusters = [1, 14], ranging.drop_extremes = 0 }
"""


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(CAMPAIGN)
    return path


def test_from_a_file_to_figures(evlcp, campaign: Path, tmp_path: Path, monkeypatch) -> None:
    results = tmp_path / "r.sqlite"
    dry = evlcp("sweep", campaign, "-o", results, "--dry-run")
    assert (dry.code, "short: 0 of 4 tasks" in dry.out, results.exists()) == (0, True, False)
    done = evlcp("sweep", campaign, "-o", results, "--workers", "1")
    assert (done.code, done.err) == (0, "")
    assert "short: 4 of 4 tasks, 4 of 4 points" in done.out
    with Store(results) as store:
        found = store.read_results()
    for outcome in Inline().run(run_job, plan_campaign(campaign).jobs[:1]):
        assert outcome.value is not None
        assert all(found[task] == one for task, one in outcome.value), "another process found something else"
    for statistics in found.values():
        tally = statistics.total()
        assert tally.frames_found >= 0.85 * tally.frames_sent > 0
        assert (tally.ber < 0.01, statistics.unmatched) == (True, 0)
    table = json.loads(evlcp("sweep", campaign, "-o", results, "--json").out)
    assert (table["done"], table["tasks"], table["failed"]) == (4, 4, 0)

    shown = evlcp("report", results)
    assert shown.code == 0
    assert all(text in shown.out for text in ("16 clusters", "two clusters", "90 to 100 m", "80 to 90 m"))
    table = json.loads(evlcp("report", results, "--json").out)
    assert [s["name"] for s in table["series"]] == ["16 clusters", "two clusters"]
    assert "| 16 clusters |" in evlcp("report", results, "--markdown").out

    monkeypatch.setattr("evlcp_sdk.study.collect.collect_results", Mock(side_effect=KeyboardInterrupt))
    done = evlcp("sweep", campaign, "-o", results)
    expected = f"evlcp: interrupted; 4 of 4 tasks are in {results}; the same command goes on\n"
    assert (done.code, done.err) == (130, expected)


def test_a_bad_campaign_is_one_line(evlcp, campaign: Path, tmp_path: Path) -> None:
    done = evlcp("sweep", campaign, "-o", tmp_path / "r.sqlite", "--set", "seeds=0")
    assert (done.code, len(done.err.splitlines())) == (2, 1)
    assert "--set seeds=0: expected campaign.KEY=" in done.err
    assert not (tmp_path / "r.sqlite").exists()


def test_a_link_of_a_scene_is_a_file_beside_the_campaign(campaign: Path, tmp_path: Path) -> None:
    job = plan_campaign(campaign).jobs[0]
    with pytest.raises(ConfigError, match="not those of the campaign's plan"):
        run_job(replace(job, environment={"source": "0" * 64}))
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "mine.toml").write_text("duration_s = 0.05\n")
    (tmp_path / "link.toml").write_text("[air]\nchip_rate_hz = 5000.0\n")
    for base in ("drive-30kmh", "scenes/mine.toml"):
        campaign.write_text(CAMPAIGN.replace('"drive-30kmh"', f'"{base}"'))
        for key in ("link", "bars.link", "bars.0.link"):
            scene = plan_campaign(campaign, [f"scene.{key}=link.toml"]).scenes[0].value
            assert links_of(scene)[0].air.chip_rate_hz == 5000.0
    with pytest.raises(ConfigError, match=r"other\.toml: cannot be read"):
        plan_campaign(campaign, ["scene.link=other.toml"])


def test_files_of_a_scene_count_by_what_they_hold(campaign: Path, tmp_path: Path) -> None:
    def ids() -> tuple[str, ...]:
        return plan_campaign(campaign, ["scene.motion.path_file=path.csv"]).points[0].tasks

    (tmp_path / "scene.toml").write_text("duration_s = 0.05\n")
    campaign.write_text(CAMPAIGN.replace('"drive-30kmh"', '"scene.toml"'))
    with pytest.raises(ConfigError, match=r"path\.csv: cannot be read"):
        ids()
    (tmp_path / "path.csv").write_text("t_s,x_m\n0,0\n")
    before = ids()
    assert ids() == before
    (tmp_path / "path.csv").write_text("t_s,x_m\n0,1\n")
    assert ids() != before


def test_messages_and_positions_of_a_campaign_are_counted(campaign: Path) -> None:
    campaign.write_text(CAMPAIGN.replace('"drive-30kmh"', f'"{ROOT}/examples/scenes/gate.toml"'))
    (_, found), _ = run_job(plan_campaign(campaign, ["scene.motion.distance_m=40"]).jobs[0])
    total = found.total()
    assert total.messages_found == total.messages_sent > 0
    assert (total.fixes > 0, total.fixes_refused, total.messages_wrong) == (True, 0, 0)
    assert total.position_95_m < 0.1


def test_the_shipped_campaigns_are_read() -> None:
    campaigns = (demo_campaign(), ROOT / "examples" / "campaigns" / "paper.toml")
    demo, paper = map(plan_campaign, campaigns)
    assert len(demo.jobs) == 20
    assert {round(s.identity["motion"]["speed_mps"] * 3.6, 1) for s in paper.scenes} == {20.0, 30.0, 40.0}
    assert [k.labels["variant"] for k in paper.links] == ["16 clusters", "two clusters"]
    # The guesses are set in one way wherever the paper's drive is simulated.
    guesses = {json.dumps([s.identity["sensor"], s.identity["lens"]]) for s in [*demo.scenes, *paper.scenes]}
    assert len(guesses) == 1
    # A road is swept in steps, by the default link and the paper's.
    plan = plan_campaign(ROOT / "examples" / "campaigns" / "road.toml")
    assert [link.labels["variant"] for link in plan.links] == ["default", "paper"]
    assert plan.links[0].identity["digest"] == resolve({}).digest
    names = [str(scene.labels["variant"]).split(": ") for scene in plan.scenes]
    assert names.pop(0) == ["clean road", "nothing"]
    assert all(len({condition for condition, _ in names[i : i + 4]}) == 1 for i in range(0, len(names), 4))
    digests = {json.dumps(scene.identity) for scene in plan.scenes}
    assert len(digests) == len(plan.scenes)


def test_the_demo(evlcp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = demo_campaign().read_text().replace("seeds = 5", "seeds = 1").replace("s = 0.3", "s = 0.07")
    (tmp_path / "short.toml").write_text(short)
    monkeypatch.setattr("evlcp_sdk.cli.demo.demo_campaign", lambda: tmp_path / "short.toml")
    done = evlcp("demo", "-o", tmp_path / "out")
    assert done.code == 0
    for begin in (80, 50, 40, 30):
        assert f"{begin} to {begin + 10} m" in done.out
    assert "0.0702" in done.out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"report.html", "demo.sqlite", "ber.png", "rmse.png", "rmse.svg"} <= names
    with Store(tmp_path / "out" / "demo.sqlite") as store:
        (series,) = summarize(store).series
    for tally in series.statistics.segments.values():
        assert tally.frames_found >= 0.9 * tally.frames_sent
        assert tally.ber <= 0.05
