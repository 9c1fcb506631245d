"""Diagnosis: each thing that may be wrong, rendered by the simulator, is the one that is named."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from evlcp_sdk.cli._app import make_app
from evlcp_sdk.diagnosis import _kernels
from evlcp_sdk.diagnosis.checks import assess_stages
from evlcp_sdk.diagnosis.diagnose import Diagnosis, diagnose, infer_link
from evlcp_sdk.diagnosis.facts import Facts
from evlcp_sdk.diagnosis.light import LightSource, LightSurvey
from evlcp_sdk.diagnosis.tallies import RunTally, TransmitterTally
from evlcp_sdk.io.open import read_events, write_events
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.sim import load_scene
from evlcp_sdk.simulated import SimulatedSource, simulate
from evlcp_sdk.testing.recordings import merge_events
from evlcp_sdk.values import Events

LINK = load_link()


def render(link=(), duration_s=0.12, seed=3, **changes: Any) -> SimulatedSource:
    light = {"background.light_w_m2": 0.01, "bars.0.led_w_m2": 8.0}
    keys = {"duration_s": duration_s, **light, **changes}
    scene = load_scene("night", keys, link=load_link(overrides=link))
    return simulate(scene, seed=seed)


def code_of(diagnosis: Diagnosis) -> str:
    """What is wrong first of all."""
    wrong = [one for one in diagnosis.checks if one.verdict == "fail"]
    doubts = [one for one in diagnosis.checks if one.verdict == "doubt"]
    return (wrong or doubts)[0].code if wrong or doubts else ""


@pytest.mark.parametrize(
    ("code", "changes", "sent", "step"),
    [
        ("", {}, (), ""),
        ("far", {"motion.distance_m": 400.0}, (), "longer lens"),
        ("one-polarity", {"sensor.p_off_miss": 0.98}, (), "bias_diff_off"),
        ("refractory", {"sensor.refr_us": 300.0}, (), "bias_refr"),
        *(("dim", {"bars.0.led_w_m2": 0.1, "seed": seed}, (), "more light") for seed in (3, 5)),
        ("defocus", {"lens.focus_m": 3.0, "duration_s": 0.06, "bars.0.led_w_m2": 30.0}, (), "focus the lens"),
        ("saturated", {"sensor.cap_mev_s": 1.5}, (), "event-rate limit"),
        ("dark", {"bars.0.led_w_m2": 0.0}, (), "is a bar in the picture"),
        ("lamp", {"bars.0.led_w_m2": 0.0, "flicker_lamps": 2, "duration_s": 0.08}, (), "is a bar in the"),
        ("outside", {"bars.0.x_m": 0.0, "bars.0.y_m": 2.45}, (), "turn the camera"),
        ("rate", {"duration_s": 0.16}, ("air.chip_rate_hz=8000",), "--set air.chip_rate_hz=8000"),
        ("profile", {"duration_s": 0.16}, ("modulation.id=wh8",), "--set modulation.id=wh8"),
        ("link", {"duration_s": 0.16}, ("air.frames_per_packet=7",), "--set air.frames_per_packet=7"),
    ],
)
def test_what_is_wrong_is_named(code: str, changes: dict[str, Any], sent: tuple[str, ...], step: str) -> None:
    with render(sent, **changes) as source:
        diagnosis = diagnose(source, LINK)
    assert code_of(diagnosis) == code
    wrong = [one for one in diagnosis.checks if one.verdict in ("fail", "doubt")]
    assert all(one.next_step for one in wrong)
    assert not code or step in next(one.next_step for one in wrong if one.code == code)
    assert not sent or [one.code for one in wrong if one.verdict == "fail"] == [code]
    assert diagnosis.headline


MESSAGES = {"bars.0.payload": "messages"}
MESSAGES |= {"world.latitude_deg": 35.1, "world.longitude_deg": 137.0, "world.height_m": 50.0}
WH8, REED_SOLOMON = ("modulation.id=wh8",), ("error-correction.id=reed-solomon",)


@pytest.mark.parametrize(
    ("warned", "sent", "read", "duration_s", "changes", "step"),
    [
        (set(), (), (), 0.2, {}, ""),
        (set(), (), (), 0.2, MESSAGES, ""),
        ({"profile"}, WH8, (), 0.13, {}, "was this sent with wh8? try --set modulation.id=wh8"),
        ({"unsure"}, (), WH8, 0.13, {}, "was this sent with raw8 or wh4x2 (modulation.id)?"),
        ({"clock"}, ("air.chip_rate_hz=10012",), (), 0.13, {}, "air.chip_rate_hz = 100"),
        ({"frames-rejected", "coverage"}, (), ("air.chip_rate_hz=9900",), 0.2, {}, "air.frames_per_packet"),
        ({"frames-rejected"}, ("air.frames_per_packet=7",), (), 0.13, {}, "--link auto"),
        # Its beacon comes again and again.
        ({"blocks-unread"}, REED_SOLOMON, (), 0.2, MESSAGES, "error-correction.id"),
        # The beacon says .96 m, the link 1.2: all distances are a quarter too long.
        ({"bar-length"}, (), ("bar.led_pitch_m=0.0125",), 0.12, MESSAGES, "compare the link's [bar]"),
        ({"clusters-hidden"}, (), (), 0.12, {"bars.0.covered": [4, 5]}, "is something before them?"),
    ],
)
def test_what_receive_warns_of(warned, sent, read, duration_s, changes, step) -> None:
    summary = receive_to_folder(render(sent, duration_s, **changes), None, load_link(overrides=read))
    assert {one["code"] for one in summary["warnings"]} == warned
    assert not warned or any(step in one["next_step"] for one in summary["warnings"])


def test_parts_of_a_near_bar_are_no_frames_of_another() -> None:
    """Pieces of a bar of 480 rows are followed before the whole of it is known."""
    near = {"motion.distance_m": 15.0, "motion.speed_mps": 0.0, "motion.vib_rate_rad_s": 0.0}
    day = {"background.light_w_m2": 1.0, "bars.0.led_w_m2": None, "sensor.hold": True, "sensor.refr_us": 20.0}
    summary = receive_to_folder(render((), 0.045, **near, **day, **{"bars.0.x_m": -0.9}), None)
    counts = summary["counts"]
    assert counts["frames"] == 13
    assert (counts["frames_rejected"], counts["frames_of_parts"] >= 10) == (0, True)
    assert summary["warnings"] == []


def test_a_restart_is_reported_in_words() -> None:
    old = {"pole_s": [[0.07, 9.0]], "seed": 1, "start_chip": 40.3, "ppm": 11.0}
    new = {"pole_s": [[0.0, 0.0702]], "seed": 2, "start_chip": 343.7}
    summary = receive_to_folder(simulate({"duration_s": 0.16, "bars": [old, new]}, seed=3), None)
    (note,) = [one for one in summary["notes"] if one["code"] == "restart"]
    text, _, rest = note["text"].partition(", begun anew ")
    assert (note["transmitter"], text) == (1, "it is transmitter 0")
    assert 70 <= float(rest.split()[0]) < 77


def first_failure(*sources: LightSource, quality=1.0, frames=0, rejected=0, duration_us=200000.0) -> str:
    """What is wrong first of all with light that the survey told, and what the receiver made of it."""
    tally = RunTally(LINK.packet)
    if frames:
        one = tally.transmitters[0] = TransmitterTally(LINK.packet)
        one.frames, one.quality_sum, one.first_frame, one.last_frame = frames, quality * frames, 0, frames - 1
        one.symbol_counts.update(range(64))
        one.ranged_frames = frames
        one.path_box_px = 410.0, 375.0, 410.0, 375.0
    counts = dict.fromkeys(("preambles", "regions_opened"), 3)
    counts |= {"frames": frames, "frames_rejected": rejected}
    counts["events"], lost = 10**6, 2000
    losses = [Loss(lost, 0, "byte", "odd words")]
    facts = Facts(LINK, tally, counts, 0.0, duration_us, losses=losses, has_survey=True, sources=sources)
    dropped, *wrong = [one for one in assess_stages(facts) if one.verdict in ("fail", "doubt")]
    # What is lost of a recording stops no light.
    assert (dropped.code, dropped.verdict) == ("dropped", "doubt")
    assert all(one.next_step for one in wrong)
    # What is wrong where frames are read all the same is a doubt.
    assert not wrong or wrong[0].verdict == ("doubt" if frames > rejected else "fail")
    return wrong[0].code if wrong else ""


BAR = LightSource(
    "code", 10_000.0, 0.9, (400, 300, 420, 450), 5.0, 140.0, 900_000, 90_000, 0.5, 300.0, 0.0,
    np.bincount(np.repeat([20, 30, 40], [5, 3, 2]), minlength=_kernels.BINS),
)  # fmt: skip
HALF = np.bincount(np.repeat([25, 35, 45, 55], 5), minlength=_kernels.BINS)
"""Of another rate: at that of the link, the mean is below 0."""

TALL = replace(BAR, box_px=(400, 40, 480, 680), wide_px=25.0, high_px=600.0)
WIDE = replace(BAR, wide_px=23.0)
SLOW = replace(BAR, kind="lamp", rate_hz=2360.0, strength=0.6, typical_us=814.0, blind_us=390.0)


@pytest.mark.parametrize(
    ("code", "source", "read"),
    [
        ("", BAR, {"frames": 40}),
        # Rows are read one after another: 120 us for 600 of them, where a chip lasts 100.
        ("near", TALL, {"rejected": 30}),
        ("near", TALL, {"frames": 40, "quality": 0.3}),
        ("", TALL, {"frames": 40}),
        ("defocus", WIDE, {"rejected": 30}),
        ("defocus", WIDE, {"frames": 40, "quality": 0.3}),
        ("", WIDE, {"frames": 40}),
        # Pixels that answer every 400 us are as regular as a lamp, but frames are none of a lamp's.
        ("refractory", SLOW, {"frames": 14, "rejected": 30}),
        ("lamp", SLOW, {"rejected": 30}),
        ("short", BAR, {"rejected": 2, "duration_us": 4e4}),
        ("", BAR, {"frames": 8, "duration_us": 4e4}),
        # Of a bar 300 m away, the image of a column of LEDs is wider than two clusters are long.
        ("frames-rejected", replace(BAR, wide_px=4.5, high_px=25.0), {"rejected": 30}),
        ("dim", replace(BAR, rises=568, events=1330), {}),
    ],
)
def test_what_light_and_receiver_say_together(code: str, source: LightSource, read: dict[str, Any]) -> None:
    assert first_failure(source, **read) == code


@pytest.mark.parametrize(
    ("code", "changes"),
    [
        ("unread", {}),
        ("", {"kind": "lamp"}),
        ("unread", {"rate_hz": 5000.0, "intervals": HALF}),
        ("", {"rate_hz": 4000.0, "intervals": HALF, "high_px": 8.0}),
        # Leaves and their edges.
        ("", {"rate_hz": 737.0, "intervals": HALF}),
    ],
)
def test_a_bar_that_is_not_read_beside_one_that_is(code: str, changes: dict[str, Any]) -> None:
    assert first_failure(BAR, replace(BAR, **{"box_px": (900, 300, 920, 450)} | changes), frames=40) == code


LAMP = (
    *("bar.rows=6", "bar.cluster_rows=6", "bar.columns=1", "bar.cluster_columns=1"),
    *("framing.id=uart", "air.frames_per_packet=20", "air.chip_rate_hz=3125"),
)


@pytest.mark.parametrize("dark", [False, True])
def test_a_framing_without_a_preamble_is_assessed_by_its_frames(dark: bool) -> None:
    scene, link = {"motion.distance_m": 30.0}, load_link(overrides=LAMP)
    scene |= {"bars.0.led_w_m2": 0.0} if dark else {}
    with render(LAMP, 0.08, **scene) as source:
        diagnosis = diagnose(source, link)
    verdicts = {one.stage: one.verdict for one in diagnosis.checks}
    assert (code_of(diagnosis), verdicts["preamble"]) == ("dark" if dark else "", "skip")
    assert (diagnosis.counts["frames"] <= 10, any(one.fits for one in diagnosis.trials)) == (dark, False)
    with render(LAMP, 0.08, **scene) as source:
        trial = infer_link(source, link)[0]
    assert (trial.changes, trial.frames <= 10, trial.fits) == ((), dark, not dark)


def survey_of(times_us: NDArray[np.float64]) -> LightSurvey:
    """Of pixels that rise so far apart, and fall 40 us after each rise; float64 (pixels, rises)."""
    rises_us = np.cumsum(np.round(np.maximum(times_us, 80.0)), 1).astype(np.int64)
    pixel = np.broadcast_to(np.arange(len(rises_us))[:, None], rises_us.shape)
    t_us = np.concatenate([rises_us.ravel(), rises_us.ravel() + 40])
    x, y = (np.tile(at.ravel(), 2) for at in (pixel % 8, pixel // 8))
    survey = LightSurvey(64, 64)
    survey.feed(merge_events(Events.of(t_us, x, y, np.repeat([1, 0], rises_us.size))))
    return survey


@pytest.mark.parametrize(
    ("speed_px_ms", "message"), [(12.0, "sweeps over the image at 12.0 px/ms"), (0.0, "")]
)
def test_light_that_sweeps_is_not_reported_to_be_weak(speed_px_ms: float, message: str) -> None:
    rng = np.random.default_rng(2)
    survey = LightSurvey(1280, 720)
    for start_us in range(0, 100_000, 10_000):
        t_us = start_us + np.sort(rng.integers(0, 10_000, 20_000))
        x = 20 + speed_px_ms * 1e-3 * t_us + rng.normal(0, 1, t_us.size)
        survey.feed(Events.of(t_us, np.rint(x).astype(int), rng.integers(300, 420, t_us.size), t_us % 2))
    assert survey.speed_px_ms() == pytest.approx(speed_px_ms, abs=0.05)
    link = load_link()
    facts = Facts(link, RunTally(link.packet), {"events": 200_000}, has_survey=True, speed_px_ms=speed_px_ms)
    light = next(one for one in assess_stages(facts) if one.stage == "light")
    assert (light.verdict, light.code) == ("fail", "motion" if message else "dark")
    assert message in light.text


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0, 2375.0, 5000.0, 10_000.0])
@pytest.mark.parametrize("late", [0.02, 0.1])
def test_a_lamp_that_is_followed_is_one_at_any_rate(rate_hz: float, late: float) -> None:
    """Each rise late by a share of a period, one in twenty missed."""
    rng = np.random.default_rng(1)
    at = np.cumsum(rng.geometric(0.95, (64, 101)), 1) + rng.normal(0, late, (64, 101))
    (lamp,), _ = survey_of(np.diff(at, axis=1) * 1e6 / rate_hz).find_sources()
    assert lamp.kind == "lamp"
    assert lamp.rate_hz == pytest.approx(rate_hz, rel=0.02 if late < 0.05 else 0.17)


def test_rare_rises_of_a_dim_code_are_no_lamps() -> None:
    """Four chips apart and more, late by a third of a chip: the hump of their times is no period."""
    rng = np.random.default_rng(1)
    chips = 3 + rng.geometric(0.5, (64, 100)) + rng.normal(0, 0.3, (64, 100))
    sources, _ = survey_of(chips * 100.0).find_sources()
    assert sources
    assert all(source.kind == "unclear" for source in sources)


def test_links_are_inferred_and_ranked() -> None:
    with render(("modulation.id=wh8", "air.pilot_every=2", "air.chip_rate_hz=8000"), 0.2) as source:
        best, *rest = infer_link(source, LINK)
    assert dict(best.changes) == {"air.chip_rate_hz": 8000, "modulation.id": "wh8", "air.pilot_every": 2}
    assert best.fits
    assert all(best.rank >= other.rank for other in rest)
    with render() as source:
        assert infer_link(source, LINK)[0].changes == ()


def run(*args: Any) -> Result:
    done = CliRunner().invoke(make_app(), [str(one) for one in args])
    assert done.exit_code == 0, done.output
    return done


def test_picture_upside_down_is_noticed(tmp_path: Path) -> None:
    with render() as source:
        events, _ = source.read()
    turned = Events(events.t_us, 1279 - events.x, 719 - events.y, events.p)
    write_events(tmp_path / "sent.raw", turned, 1280, 720)
    diagnosis = diagnose(tmp_path / "sent.raw", LINK)
    assert code_of(diagnosis) == "turned"
    assert diagnosis.counts["frames_rejected"] == 0


def test_polarities_that_are_exchanged_are_found(tmp_path: Path, demo_raw: Path) -> None:
    events = read_events(demo_raw)
    np.savez(tmp_path / "a.npz", t=events.t_us, x=events.x, y=events.y, p=1 - events.p)
    diagnosis = diagnose(tmp_path / "a.npz", LINK)
    assert code_of(diagnosis) == "polarity"
    assert "all fit where ON and OFF are exchanged" in diagnosis.headline
    assert code_of(diagnose(f"list:{tmp_path / 'a.npz'}?inverted=1", LINK)) == ""


def test_a_recording_without_events_fails_once(tmp_path: Path) -> None:
    (path := tmp_path / "none.csv").write_text("t_us,x,y,p\n")
    verdicts = [one.verdict for one in diagnose(path, LINK).checks]
    assert (verdicts[0], set(verdicts[1:])) == ("fail", {"skip"})


def test_command_says_it_in_words_as_json_and_on_a_page(tmp_path: Path) -> None:
    recording, page = tmp_path / "sent.raw", tmp_path / "slow.html"
    render(("air.chip_rate_hz=8000",)).save(recording)
    shown = run("diagnose", recording, "-o", page).stdout
    assert "blinks at 8 kHz, the link says 10 kHz" in shown
    assert "next: --set air.chip_rate_hz=8000" in shown
    text = page.read_text()
    assert "http" not in text.replace("http-equiv", "")
    assert text.count("data:image/png;base64,") == 2
    result = json.loads(run("diagnose", recording, "--json").stdout)
    assert [one["code"] for one in result["checks"] if one["verdict"] == "fail"] == ["rate"]
    (bar,) = result["sources"]
    assert (bar["kind"], bar["rate_hz"]) == ("code", pytest.approx(8000, rel=3e-3))
    # 0.96 m of 7202 px at 50 m.
    assert bar["size_px"][1] == pytest.approx(0.96 * 7202 / 50, abs=8)


def test_receive_takes_the_link_that_fits(tmp_path: Path) -> None:
    render(("modulation.id=wh8",)).save(tmp_path / "sent.raw")
    reported = run("receive", tmp_path / "sent.raw", "-o", tmp_path / "out", "--link", "auto")
    assert "link --set modulation.id=wh8" in reported.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["codebook"]["profile"] == "wh8"


def count_twin(events: Events, shape: tuple[int, int], shift: int, calm_us: int) -> tuple[Any, Any, Any]:
    """The counts of the kernel, pixel by pixel."""
    cells = ((shape[0] - 1 >> shift) + 1, (shape[1] - 1 >> shift) + 1)
    kinds = (_kernels.BINS, np.uint32), (_kernels.SHORT, np.uint32), (2, np.int64)
    intervals, gaps, signs = counts = tuple(np.zeros((*cells, n), kind) for n, kind in kinds)
    fine, coarse, wide = _kernels.FINE_US, _kernels.COARSE_US, _kernels.FINE_US * _kernels.FINE
    for y, x in np.ndindex(shape):
        mine, cell = events[(events.x == x) & (events.y == y)], (y >> shift, x >> shift)
        rise, last, before = -math.inf, -math.inf, 1
        for t, p in zip(mine.t_us.tolist(), mine.p.tolist(), strict=True):
            gap, since = t - last, t - rise
            if gap < fine * _kernels.SHORT:
                gaps[cell][gap // fine] += 1
            signs[cell][p] += 1
            if p and since >= _kernels.MIN_RISE_US and (before == 0 or gap > calm_us):
                if since < wide:
                    intervals[cell][since // fine] += 1
                elif since < wide + coarse * _kernels.COARSE:
                    intervals[cell][_kernels.FINE + (since - wide) // coarse] += 1
                rise = t
            last, before = t, p
    return counts


def test_kernel_counts_as_its_twin_does() -> None:
    rng = np.random.default_rng(5)
    shape = (12, 20)
    x, y, p = (rng.integers(0, most, 4000) for most in (20, 12, 2))
    events = Events.of(np.cumsum(rng.integers(0, 9, 4000)), x, y, p)
    expected = count_twin(events, shape, 3, 400)
    long_ago = np.iinfo(np.int64).min // 2
    given = [np.full(shape, long_ago), np.ones(shape, np.uint8), np.full(shape, long_ago)]
    counts = [np.zeros_like(one) for one in expected]
    for part in (events[:1500], events[1500:]):
        columns = part.t_us, part.x, part.y, part.p
        _kernels.add_events(columns, tuple(given), tuple(counts), 3, 400)
    for one, other in zip(counts, expected, strict=True):
        np.testing.assert_array_equal(one, other)
