"""Links of every kind through simulate, receive, score, compare and sweep, which agree with each other."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import chips_of_values, hadamard
from evlcp_sdk.formatting import to_toml_value
from evlcp_sdk.plugin.hooks import Algorithm
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Modulation
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import Scene, Simulation, load_scene, truth_of
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.measure import statistics_of
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.study.task import plan_campaign
from tests.conftest import Brings

Settings = dict[str, Any]


@dataclass(frozen=True)
class Four(Modulation):
    """Two bits a symbol: a modulation of somebody else's."""

    def codewords(self) -> NDArray[np.uint8]:
        return chips_of_values(np.repeat(hadamard(4), 2, axis=1))


@pytest.fixture
def _stranger(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stranger's package is installed."""
    load, stranger = Registry.load, Brings(Algorithm("modulation", "four", f"{__name__}:Four", 3, "two bits"))
    monkeypatch.setattr(Registry, "load", lambda *plugins: load(stranger, *plugins))


def column(clusters: int, leds: int) -> Settings:
    return {"bar.rows": clusters * leds, "bar.cluster_rows": leds, "bar.led_pitch_m": 0.96 / clusters / leds}


PANEL = {"rows": 16, "columns": 16, "led_pitch_m": 0.02, "cluster_rows": 4, "cluster_columns": 4}
LAMP = {"bar.rows": 6, "bar.columns": 1, "bar.cluster_rows": 6, "bar.cluster_columns": 1}

LINKS: dict[str, Settings] = {
    "32 clusters": column(32, 3),
    "a panel": {f"bar.{key}": value for key, value in PANEL.items()},
    "few pilots of barker13": {"pilots.id": "barker13", "air.pilot_every": 4, "air.frames_per_packet": 20},
    "a stranger's modulation of 4 clusters": {**column(4, 6), "modulation.id": "four"},
    "no pair code": {"modulation.id": "nrz", "modulation.bits": 6, "air.pilot_every": 4},
    "pulses": {"modulation.id": "ppm", "modulation.pulses": 2},
    "a quarter of the light": {"modulation.id": "wh4x2-dimmed", "pilots.id": "wh-dimmed"},
    "characters": {**LAMP, "framing.id": "uart", "framing.parity": "even"},
}
DURATIONS_S = {"a panel": 0.05, "a quarter of the light": 0.1, "characters": 0.09}
SEED = 2


def options(settings: Settings, before: str = "") -> list[str]:
    return [part for k, v in settings.items() for part in ("--set", f"{before}{k}={to_toml_value(v)}")]


def run(evlcp, *args: str | Path) -> str:
    done = evlcp(*args)
    assert (done.code, done.err) == (0, "")
    out: str = done.out
    return out


@pytest.mark.usefixtures("_stranger")
@pytest.mark.parametrize("name", LINKS)
def test_all_commands_agree(name: str, evlcp, tmp_path: Path) -> None:
    link = LINKS[name]
    raw, out, results = tmp_path / "r.raw", tmp_path / "out", tmp_path / "r.sqlite"
    scene: Settings = {"duration_s": DURATIONS_S.get(name, 0.07), "motion.distance_m": 40.0}
    scene_options = [*options(scene), *options(link, "link.")]
    run(evlcp, "simulate", "--preset", "drive-30kmh", "-o", raw, "--seed", str(SEED), *scene_options)
    run(evlcp, "receive", raw, "-o", out, *options(link))
    score = json.loads(run(evlcp, "score", out, raw.with_suffix(".truth.json"), "--json"))
    (plain,), (road,) = score["bars"], score["road"]["bars"]
    # Frames before the first pilot, and those from which no pilot follows, may be lost.
    most_lost = 2 * (link.get("air.pilot_every", 1) - 1)
    assert 8 <= plain["frames_sent"] - most_lost <= plain["frames_found"]
    assert score["unmatched"] == 0
    assert road["ber"] == 0
    assert road["erased"] <= 0.02

    result = json.loads(run(evlcp, "compare", raw, "--variant", "it:", *options(link), "--json"))
    (row,) = result["rows"]
    in_scene, in_link = (
        "".join(f"set.{key} = {to_toml_value(value)}\n" for key, value in some.items())
        for some in (scene, link)
    )
    (tmp_path / "c.toml").write_text(
        f'[campaign]\nname = "one"\nfirst_seed = {SEED}\n[scene]\nbase = "drive-30kmh"\n{in_scene}'
        f"[link]\n{in_link}"
    )
    run(evlcp, "sweep", tmp_path / "c.toml", "-o", results, "--workers", "0")
    (swept,) = json.loads(run(evlcp, "compare", results, "--json"))["rows"]
    for one in (row, swept):
        assert (one["frames"], one["unmatched"], one["echoes"]) == (score["rows"], 0, 0)
        for key in ("frames_sent", "frames_found", "ranged"):
            assert one[key] == plain[key] == road[key], key
        # To the plain score, a symbol that is not given is a wrong one.
        for key in ("bits", "bit_errors"):
            assert one[key] == road[key], key
        assert (one["erased_share"], one["claimed_share"]) == (road["erased"], road["claimed"])
        for key in ("rmse_m", "bias_m"):
            # frames.csv has tenths of millimetres.
            assert one[key] == pytest.approx(road[key], abs=1.1e-4), key
    for key in ("packets", "rmse_m", "bias_m", "nees", "sigma_m", "gross", "filtered_rmse_m"):
        want = swept[key]
        # Sums of a sweep are added in another order.
        assert row[key] == (want if want is None else pytest.approx(want, rel=1e-7)), key


UNEVEN = [
    [x, y + 0.02 * i, 0.0, k]
    for k, (x, y, n) in enumerate(((-0.3, 0, 3), (0.1, 0.1, 9), (0.4, -0.2, 1), (0.2, 0.3, 5)))
    for i in range(-n, n + 1)
]
APART = ["link.bar.shape=columns", "link.bar.apart_m=1.2", "link.bar.rows=24"]
HALF_SEEN = ["link.bar.shape=columns", "link.bar.apart_m=2.0", "link.bar.rows=24"]
SHORT = ["link.air.frames_per_packet=5", "duration_s=0.06"]
ONE = ["link.bar.rows=6", "duration_s=0.1"]
BARS: dict[str, tuple[list[str], int, int, float]] = {
    "ring": (["link.bar.shape=ring", "link.bar.leds=12", "link.bar.radius_m=0.25", *SHORT], 10, 3, 0.15),
    # Until the parts of a transmitter that stands apart are put together, frames are lost.
    "apart": ([*APART, *SHORT], 10, 3, 0.12),
    "lamps": (["link.bar.shape=columns", *SHORT], 10, 3, 0.1),
    "uneven": (["link.bar.shape=table", f"link.bar.leds={UNEVEN}", *SHORT], 10, 3, 0.4),
    "one bright LED": (["link.bar.shape=table", "bars.led_mw_sr=500", *SHORT], 10, 1, math.inf),
    # The mean of all pixels goes to the lamp that has more of them awake, and frames were lost.
    "apart, shaken": ([*APART, "duration_s=0.12"], 30, 0, 0.3),
    # Half in view: the column that the picture's edge cuts pulled the distance by 20 cm.
    "apart, cut": ([*HALF_SEEN, "duration_s=0.06", "motion.distance_m=30"], 10, 3, 0.1),
    # Chips of 50 us are nearly as short as the pixels' latencies.
    "fast": (["link.air.chip_rate_hz=20000.0", "duration_s=0.12"], 50, 0, 0.3),
    # Its pilot has one value throughout, and its data resemble a preamble now and then.
    "one cluster": ([*ONE, "link.decoding.id=motion-feedback"], 20, 0, math.inf),
    "one cluster, paper": ([*ONE, "link.decoding.id=wh-transform"], 20, 0, math.inf),
    "one cluster, any code": ([*ONE, "link.decoding.id=edges"], 20, 0, math.inf),
}
"""Settings of the scene, least number of frames, how many may be lost, largest RMSE."""


@pytest.mark.parametrize(("settings", "least", "lost", "rmse_m"), BARS.values(), ids=BARS)
def test_any_layout_is_received_and_measured(settings, least, lost, rmse_m) -> None:
    found = receive_scene(load_scene("night", settings))
    assert found.frames_found >= found.frames_sent - lost > least
    assert found.bit_errors == 0
    assert lost or found.erased == 0
    assert not found.ranged or found.rmse_m < rmse_m


def receive_scene(scene: Scene) -> Tally:
    simulation = Simulation(scene, 1)
    truth = truth_of(simulation)
    receiver = Receiver(truth.bars[0].link)
    packets = [packet for events in simulation.stream() for packet in receiver.feed(events)]
    return statistics_of(frames_of(packets + receiver.close()), truth).total()


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"bar.rows": 48}, "bar.rows: sent with 96, received with 48"), ({"error-correction.id": "none"}, None)],
)
def test_another_link_is_refused_by_all(settings, message, evlcp, tmp_path) -> None:
    raw, campaign = tmp_path / "r.raw", tmp_path / "c.toml"
    run(evlcp, "simulate", "--preset", "night", "-o", raw, "--set", "duration_s=0.002")
    run(evlcp, "receive", raw, "-o", tmp_path / "out", *options(settings))
    campaign.write_text(
        '[campaign]\nname = "other"\n[scene]\nbase = "night"\n[scene.set]\nduration_s = 0.002\n'
        'link.modulation.id = "wh4x2"\n'
    )
    for name, place, command in (
        ("score", f"{tmp_path}/out", ("score", tmp_path / "out", tmp_path / "r.truth.json")),
        ("compare", f"{raw}: --variant v", ("compare", raw, "--variant", "v:", *options(settings))),
        (
            *("sweep", "1 job failed: the scene"),
            ("sweep", campaign, "-o", tmp_path / "r.sqlite", "--workers", "0", *options(settings, "link.")),
        ),
    ):
        done = evlcp(*command)
        assert done.code == (0 if message is None else 2), name
        line = f"evlcp: {place}: bar 0 was sent with another link: {message}\n"
        assert done.err == ("" if message is None else line)


def test_links_that_share_what_is_on_air_share_a_rendering(evlcp, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(
        '[campaign]\nname = "some"\nseeds = 2\n[scene]\nbase = "night"\n[link.variants]\n'
        'paper = {}\nother-ranging = { ranging.id = "poc" }\nslow = { air.chip_rate_hz = 5000.0 }\n'
        'other = { pilots.id = "barker13" }\nlike = { pilots.id = "barker13", decoding.id = "ml-soft" }\n'
    )
    plan = plan_campaign(tmp_path / "c.toml")
    assert [len(job.tasks) for job in plan.jobs] == [2, 1, 2] * 2
    assert [job.seed for job in plan.jobs] == [0] * 3 + [1] * 3
    tasks = [task for job in plan.jobs for task in job.tasks]
    assert sorted(task.id for task in tasks) == sorted(id for point in plan.points for id in point.tasks)
