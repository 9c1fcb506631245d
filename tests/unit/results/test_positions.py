"""Position files: what is in them, what is not left behind."""

import dataclasses
import io
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pynmea2
import pytest
from PIL import Image

from evlcp_sdk.files import STAGE_PREFIX
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place import navigator
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.gnss import GnssLog, geoid_m
from evlcp_sdk.place.navigator import Navigator, Place, PositionPlan, Settled
from evlcp_sdk.place.observations import project_bars
from evlcp_sdk.place.trajectory import step_trajectory
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.report.recording import plot_positions, seconds_axis
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.geojson import GeoJson
from evlcp_sdk.results.nmea import Nmea
from evlcp_sdk.results.position_tables import AlternativesCsv, FixesCsv, PointsCsv
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.results.summary import RunEnd
from evlcp_sdk.results.trail import Trail, split_at_antimeridian
from evlcp_sdk.results.writer import ResultWriter
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.utc import PulseClock
from evlcp_sdk.values import (
    Alternative,
    Events,
    FailedBar,
    Fix,
    Frame,
    Packet,
    Range,
    Region,
    SoftSymbols,
    Triggers,
)
from tests.conftest import rows_of

LINK = load_link()
ZERO = datetime(2026, 3, 1, 10, 15, tzinfo=UTC)
SITE = BarSite(7, 35.0, 137.0, 54.0, length_m=0.96)
ATTITUDE = Attitude(5.0, 0.0, 0.0, 0.05, 0.1)
PACKET_US = LINK.packet.packet_chips * LINK.packet.chip_us
SOFT = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), 1.0)


def packets(count: int, seed: int = 1, transmitter: int = 0) -> list[Packet]:
    """A camera that drives north at 10 m/s towards a bar."""
    rng, enu = np.random.default_rng(seed), SITE.cluster_positions_m(16, LocalAxes.of([SITE]))

    def frame(n: int, k: int) -> Frame:
        t_us = n * PACKET_US + 2600 + k * 3200
        place = np.array([2.0, -60 + 10e-6 * t_us, -4.0])
        points, _ = project_bars(enu, place, ATTITUDE.rotation(), LINK.camera)
        points += rng.normal(0, 0.1, points.shape)
        seen = points, np.full(16, 0.1), t_us
        return Frame(transmitter, n, k, t_us, SOFT, Range(math.nan, math.nan, 0), None, 0.0, 0.0, *seen)

    return [
        Packet(transmitter, n, n * PACKET_US, 100.0, tuple(frame(n, k) for k in range(10)), 10)
        for n in range(count)
    ]


def satellites(times_us: Sequence[float], off_m: float = 0.0) -> GnssLog:
    """What a receiver says of that drive, to half a metre; all of it `off_m` to the east."""
    t_us = np.asarray(times_us, np.float64)
    enu = np.stack([2.0 + off_m + 0 * t_us, -60 + 10e-6 * t_us, -4.0 + 0 * t_us], 1)
    place = np.stack(LocalAxes.of([SITE]).to_geodetic(enu), 1)
    return GnssLog(t_us, place, np.tile(0.25 * np.eye(3), (len(t_us), 1, 1)))


def write(
    folder: Path, stream: Iterable[Packet], plan: PositionPlan, *sinks: str, last_us: int = 0, **known: Any
) -> dict[str, Any]:
    """The position figures of a result, of a recording from 0 on where its last time is given."""
    given = {"attitude": ATTITUDE, "plan": plan} | known
    with ResultWriter(folder, LINK, sinks=sinks, **given) as results:
        if last_us:
            results.events(Events.of([0, last_us], [1, 1], [1, 1], [1, 1]))
        results.write(stream)
        return dict(results.finish(RunEnd("complete"))["positions"])


@contextmanager
def sink_of(kind: type[AlternativesCsv | PointsCsv], folder: Path) -> Iterator[Sink]:
    with ResultFolder(folder, [kind.name]) as files:
        yield kind(files, Run("", LINK))
        files.finish()


def check_places(found: list[dict[str, str]], most_sigma_m: float = math.inf) -> None:
    """They are where the camera was, as far as their sigmas say."""
    axes = LocalAxes.of([SITE])
    for row in found:
        place = axes.to_enu(*(float(row[k]) for k in ("latitude_deg", "longitude_deg", "height_m")))
        sigma_m = np.array([float(row[f"sigma_{axis}_m"]) for axis in ("east", "north", "up")])
        assert (np.abs(place - [2.0, -60 + 10e-6 * float(row["t_us"]), -4.0]) < 5 * sigma_m).all()
        assert max(sigma_m) < most_sigma_m


def features(folder: Path) -> list[dict[str, Any]]:
    return list(json.loads((folder / "fixes.geojson").read_text())["features"])


def sentences(folder: Path) -> list[Any]:
    """Those of `fixes.nmea`, by an independent reader."""
    return [pynmea2.parse(line, check=True) for line in (folder / "fixes.nmea").read_text().splitlines()]


def test_files_of_a_drive(tmp_path: Path) -> None:
    result = write(tmp_path, packets(13), PositionPlan((SITE,)), "figures", clock_zero=ZERO)
    fixes = rows_of(tmp_path / "fixes.csv")
    assert result["fixes"] == len(fixes) == 12
    assert result["bars"] == {"0": 7}
    assert [(r["part"], r["what"]) for r in result["learnt"]] == [
        ("attitude", name) for name in ("pitch_deg", "roll_deg", "heading_deg")
    ]
    track = rows_of(tmp_path / "track.csv")
    check_places(fixes + track)
    assert {row["refusal"] for row in fixes} == {""}
    assert float(track[6]["speed_m_s"]) == pytest.approx(10, abs=0.5)
    assert min(abs(float(track[6]["course_deg"]) - c) for c in (0, 360)) < 3
    shapes = features(tmp_path)
    kinds = [s["geometry"]["type"] for s in shapes]
    assert kinds == ["Point"] * 12 + ["LineString", "Point"]
    assert shapes[-1]["geometry"]["coordinates"] == [137.0, 35.0, 54.0]
    assert len(shapes[12]["geometry"]["coordinates"]) == 12
    _, latitude, _ = shapes[3]["geometry"]["coordinates"]
    assert latitude == pytest.approx(float(fixes[3]["latitude_deg"]), abs=2e-9)
    # Of a lone bar nothing is protected, and each fix says so.
    told_nmea = sentences(tmp_path)
    assert [one.sentence_type for one in told_nmea] == ["TXT", "GGA", "RMC", "GST", "GBS"] * 12
    alarm, _, last, spread, fault = told_nmea[-5:]
    assert alarm.text == "NO PROTECTION LEVEL"
    assert (fault.lat_err, fault.sat_prn_num_f, fault.est_bias) == ("", "", "")
    assert spread.std_dev_altitude == pytest.approx(float(track[-1]["filtered_sigma_up_m"]), abs=6e-4)
    assert last.spd_over_grnd * 1852 / 3600 == pytest.approx(10, abs=0.5)
    assert last.datestamp.isoformat() == "2026-03-01"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["positions"] == json.loads(json.dumps(result))
    assert not list(tmp_path.glob(f"{STAGE_PREFIX}*"))
    assert (tmp_path / "track.png").read_bytes().startswith(b"\x89PNG")


def test_covariance_and_integrity_are_in_every_file(tmp_path: Path) -> None:
    """Of a fix with everything to tell, and of one that is refused as its parts contradict one another."""
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.05, 0.02, 0.1]])
    spread = root @ root.T
    fix = dataclasses.replace(
        Fix.from_refusal(2e6, (0, 1), "", ""),
        latitude_deg=35.0, longitude_deg=137.0, height_m=5.0, enu_m=np.zeros(3), covariance_m2=spread,
        noise_m2=spread, heading_deg=1.0, pitch_deg=2.0, roll_deg=3.0, heading_sigma_deg=0.1,
        misfit=0.64, freedom=60, hpl_m=1.25, vpl_m=math.inf, excluded=("bar 2", "heading"),
        undetected_m=np.array([0.5, 0.25, math.inf]),
        failed=FailedBar(2, np.array([0.3, 0.0, 0.4]), np.diag([0.01, 0.04, 0.01]), 0.0123),
    )  # fmt: skip
    wrong = Fix.from_refusal(3e6, (0, 1), "misfit", "heading does not fit the rest")
    assert fix.alarms == ("excluded", "unavailable")
    assert wrong.alarms == ("misfit",)
    assert Fix.from_refusal(3e6, (0,), "heading-unknown", "").alarms == ()
    point = step_trajectory(None, fix, ErrorModel())
    place = Place(2e6, 35.0, 137.0, 5.0, point.mean[:3], point.covariance_m2, 0.0, 0.0, False, True)
    with ResultFolder(tmp_path, ["fixes.csv", "fixes.nmea", "fixes.geojson"]) as folder:
        run = Run("", LINK, PositionPlan((SITE,)), Navigator(LINK, PositionPlan((SITE,))), None)
        for sink in (FixesCsv(folder, run), Nmea(folder, run), GeoJson(folder, run)):
            sink.fix(fix, place)
            sink.fix(wrong, None)
            sink.finish()
        folder.finish()
    given, refused = rows_of(tmp_path / "fixes.csv")
    sigmas = [float(given[f"sigma_{axis}_m"]) for axis in ("east", "north", "up")]
    assert sigmas == pytest.approx(np.sqrt(np.diag(spread)).tolist(), abs=1e-4)
    pairs = [float(given[f"cov_{pair}_m2"]) for pair in ("east_north", "east_up", "north_up")]
    assert pairs == pytest.approx(spread[[0, 0, 1], [1, 2, 2]].tolist(), rel=1e-5)
    assert [given[k] for k in ("misfit", "freedom", "hpl_m", "vpl_m")] == ["0.6400", "60", "1.250", ""]
    assert (given["excluded"], given["alarms"]) == ("bar 2; heading", "excluded unavailable")
    assert (refused["alarms"], refused["hpl_m"], refused["cov_east_up_m2"]) == ("misfit", "", "")
    point_, lost = features(tmp_path)
    assert np.allclose(point_["properties"]["covariance_m2"], spread, rtol=1e-5)
    assert (point_["properties"]["hpl_m"], point_["properties"]["vpl_m"]) == (1.25, None)
    assert lost["geometry"] is None
    assert lost["properties"]["alarms"] == ["misfit"]
    texts = sentences(tmp_path)
    assert [t.sentence_type for t in texts] == ["TXT", "TXT", "GGA", "RMC", "GST", "GBS", "TXT", "GGA", "RMC"]
    assert texts[0].text == "EXCLUDED bar 2 heading"
    assert texts[6].text == "MISFIT"
    gst = texts[4]
    major, minor = np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[::-1])
    assert (gst.rms, gst.std_dev_major, gst.std_dev_minor) == pytest.approx((0.8, major, minor), abs=1e-3)
    # Along the major axis, clockwise from north, the variance is the largest.
    way = math.radians(gst.orientation)
    along = np.array([math.sin(way), math.cos(way)])
    assert along @ spread[:2, :2] @ along == pytest.approx(major**2, rel=1e-4)
    assert gst.std_dev_latitude == pytest.approx(math.sqrt(spread[1, 1]), abs=1e-3)
    gbs = texts[5]
    assert gbs.timestamp == gst.timestamp
    assert (gbs.lat_err, gbs.lon_err, gbs.alt_err) == ("0.250", "0.500", "")
    assert (gbs.sat_prn_num_f, float(gbs.pro_miss)) == ("02", 0.0123)
    assert (float(gbs.est_bias), float(gbs.est_bias_dev)) == (0.5, 0.1)


def test_a_track_goes_on_between_bars(tmp_path: Path) -> None:
    """Bars at first and last, satellites all the time, and outside of the recording, which do not count."""
    stream = [p for p in packets(60) if not 15 <= p.packet < 45]
    plan = PositionPlan((SITE,), satellites(np.arange(-5, 40) * 1e5 + 7))
    result = write(tmp_path, stream, plan, "figures", "mcap", clock_zero=ZERO, last_us=int(60 * PACKET_US))
    assert (result["gnss"], result["gnss_left_out"], result["gnss_without_heading"]) == (21, 0, 0)
    fixes, track = rows_of(tmp_path / "fixes.csv"), rows_of(tmp_path / "track.csv")
    assert result["gnss_outside"] == 24
    assert [r["t_us"] for r in fixes] == [r["t_us"] for r in track]
    assert [float(r["t_us"]) for r in track] == sorted(float(r["t_us"]) for r in track)
    sources = [r["source"] for r in track]
    assert (sources.count("gnss"), sources.count("bars")) == (21, result["fixes"])
    check_places(track, 0.5)
    shapes = features(tmp_path)
    assert [s["properties"]["source"] for s in shapes if "source" in s["properties"]].count("gnss") == 21
    assert len(sentences(tmp_path)) > len(fixes)


def test_bars_and_satellites_that_contradict_one_another(tmp_path: Path) -> None:
    plan = PositionPlan((SITE,), satellites(np.arange(5, 20) * 1e5 + 7, 20.0))
    result = write(tmp_path, packets(60), plan, clock_zero=ZERO, last_us=int(60 * PACKET_US))
    assert result["alarms"]["contradicted"] == result["gnss_left_out"] == result["gnss"] == 15
    fixes = rows_of(tmp_path / "fixes.csv")
    assert {r["contradicted"] for r in fixes if r["source"] == "gnss"} == {"bars"}
    warnings = json.loads((tmp_path / "summary.json").read_text())["warnings"]
    (line,) = [w["text"] for w in warnings if w["code"] == "gnss-contradicted"]
    assert line.startswith("15 times bars and GNSS contradict")
    assert "GNSS CONTRADICTED BY BARS" in (tmp_path / "fixes.nmea").read_text()
    plan = PositionPlan((SITE,), satellites([1e6]))
    link = load_link(overrides=["position.antenna_m=[1,0,0]"])
    way = Navigator(link, plan, Attitude(5.0, 0.0))
    way.extend_span(0, 2e6)
    assert way.close() == ([], ())
    assert way.counts["gnss_without_heading"] == 1
    write(tmp_path / "late", packets(4), PositionPlan((SITE,), satellites([1e9, 2e9])))
    output = json.loads((tmp_path / "late" / "summary.json").read_text())["warnings"]
    assert "none of 2 GNSS fixes is within the recording's time" in [one["text"] for one in output]


def test_the_poses_that_fit_are_a_file(tmp_path: Path) -> None:
    turned = (10.0, 5.0, 0.0)
    both = (
        Alternative(35.0, 137.0, 5.0, np.zeros(3), np.eye(3) * 0.04, *turned, 1.0),
        Alternative(35.1, 137.0, 5.0, np.ones(3), np.full((3, 3), math.nan), *turned, 0.25),
    )
    fix = dataclasses.replace(Fix.from_refusal(2e6, (0, 1), "two-solutions", ""), alternatives=both)
    with sink_of(AlternativesCsv, tmp_path) as sink:
        sink.fix(fix, None)
        sink.fix(Fix.from_refusal(3e6, (0,), "heading-unknown", ""), None)
    first, second = rows_of(tmp_path / "alternatives.csv")
    assert (first["number"], first["likelihood"], first["sigma_up_m"]) == ("0", "1", "0.2000")
    assert (second["latitude_deg"], second["sigma_up_m"], second["bars"]) == ("35.1000000000", "", "0 1")


def test_the_figure_of_a_track() -> None:
    way = Navigator(LINK, PositionPlan((SITE,)), ATTITUDE)
    way.feed(packets(13))
    _, settled = way.close()
    _, close, *_ = plot_positions(settled, way.bars_enu_m(), seconds_axis(0.0))
    ring = next(shape for shape in close.shapes if shape.kind == "ring")
    # Drawn larger by as much as the legend says.
    label = ring.name
    times = int(label.removeprefix("95 % ellipse, ").removesuffix(" times as large")) if "," in label else 1
    # 95 % of a normal distribution of the plane lies within 2.4477 sigma.
    fix = settled[0].fix
    values = np.linalg.eigvalsh(fix.covariance_m2[:2, :2])
    want = (2 * 2.44775 * times * np.sqrt(values)).tolist()
    radii = np.linalg.norm(ring.points - fix.enu_m[:2], axis=1)
    assert (2 * radii.min(), 2 * radii.max()) == pytest.approx(tuple(want), rel=1e-4)


def test_a_track_across_the_180th_meridian_is_cut() -> None:
    assert split_at_antimeridian([]) == [[]]
    for sign in (1.0, -1.0):
        way = [
            [sign * (180 - 1e-5), 35.0, 1.0],
            [sign * (-180 + 2e-5), 35.3, 4.0],
            [sign * (-180 + 3e-5), 35.4, 5.0],
        ]
        one, two = split_at_antimeridian(way)
        assert one == [way[0], pytest.approx([sign * 180, 35.1, 2.0])]
        assert two == [pytest.approx([sign * -180, 35.1, 2.0]), way[1], way[2]]


def test_a_track_that_begins_anew_is_another_line() -> None:
    places = [
        Place(n, 35.0 + n, 137.0, 5.0, np.zeros(3), np.eye(3), 0.0, 0.0, False, starts=n in (0, 3))
        for n in range(6)
    ]
    settled, trail = [Settled(Fix.from_refusal(0.0, (), "", ""), one, one) for one in places], Trail()
    lines = [line for part in (settled[:2], settled[2:5], settled[5:]) for line in trail.lines(part)]
    assert [[point[1] - 35 for point in line] for line in lines] == [[0, 1], [1, 2], [3, 4], [4, 5]]


def test_points_of_frames(tmp_path: Path) -> None:
    (packet,) = packets(1)
    frames = [
        dataclasses.replace(f, range=Range(d, 0.2, 9), x_px=700.0, y_px=300.0, echo_of=e)
        for f, d, e in zip(packet.frames, (50.0, math.nan, 40.0), (None, None, 1), strict=False)
    ]
    with sink_of(PointsCsv, tmp_path) as sink:
        sink.packet(dataclasses.replace(packet, frames=tuple(frames)))
    (row,) = rows_of(tmp_path / "points.csv")
    point = np.array([float(row[f"{axis}_m"]) for axis in "xyz"])
    np.testing.assert_allclose(LINK.camera.project(point), [700, 300], atol=0.02)
    assert point[2] == 50
    assert float(row["cov_zz_m2"]) == pytest.approx(0.2**2 + (50 * ErrorModel.stretch_share) ** 2, rel=1e-4)
    assert float(row["cov_xz_m2"]) > 0 > float(row["cov_yz_m2"])


def test_refused_fixes_are_listed_and_counted(tmp_path: Path) -> None:
    stranger = dataclasses.replace(SITE, transmitter=3)
    result = write(tmp_path / "stranger", packets(5), PositionPlan((stranger,)))
    assert result["refused"] == {"no-site": 4}
    assert result["sites_unseen"] == [SITE.transmitter_id]
    result = write(tmp_path, packets(7), PositionPlan((SITE,)), attitude=Attitude(5.0, 0.0))
    assert result["fixes"] == 0
    assert result["refused"] == {"heading-unknown": 6}
    found = rows_of(tmp_path / "fixes.csv")
    assert {r["refusal"] for r in found} == {"heading-unknown"}
    assert found[0]["latitude_deg"] == ""
    assert found[0]["detail"]
    assert rows_of(tmp_path / "track.csv") == []
    assert sentences(tmp_path)[0].gps_qual == 0
    assert plot_positions([], {}, seconds_axis(0.0)) == []


def test_a_long_track_is_smoothed_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, stream = PositionPlan((SITE,)), packets(40)
    write(tmp_path / "whole", stream, plan)
    monkeypatch.setattr(navigator, "_BLOCK", 12)
    write(tmp_path / "blocks", stream, plan)
    whole, blocks = (rows_of(tmp_path / name / "track.csv") for name in ("whole", "blocks"))
    assert [r["t_us"] for r in whole] == [r["t_us"] for r in blocks]
    apart = [abs(float(a["height_m"]) - float(b["height_m"])) for a, b in zip(whole, blocks, strict=True)]
    assert max(apart) < 0.2 * float(whole[0]["sigma_up_m"])
    shapes = [shape["geometry"] for shape in features(tmp_path / "blocks")]
    lines = [shape["coordinates"] for shape in shapes if shape["type"] == "LineString"]
    assert len(lines) == 3
    for before, after in pairwise(lines):
        assert before[-1] == after[0]


def test_kml_is_read_back(tmp_path: Path) -> None:
    write(tmp_path, packets(6), PositionPlan((SITE,)), "kml", clock_zero=ZERO)
    names = {"k": "http://www.opengis.net/kml/2.2"}
    placemarks = ElementTree.parse(tmp_path / "fixes.kml").getroot().findall("k:Document/k:Placemark", names)

    def places(marks: Sequence[ElementTree.Element], kind: str) -> list[list[float]]:
        texts = " ".join(mark.findtext(f"k:{kind}/k:coordinates", "", names) for mark in marks)
        return [[float(part) for part in place.split(",")] for place in texts.split()]

    sea_m = geoid_m(35.0, 137.0)
    assert 37 < sea_m < 39
    fixes, track = (rows_of(tmp_path / f"{name}.csv") for name in ("fixes", "track"))
    *points, way, bar = placemarks
    keys = "longitude_deg", "latitude_deg", "height_m"
    want = np.array([[float(row[key]) for key in keys] for row in fixes]) - [0, 0, sea_m]
    assert (np.abs(places(points, "Point") - want) < [1e-8, 1e-8, 0.11]).all()
    for row, mark in zip(fixes, points, strict=True):
        at = datetime.fromisoformat(mark.findtext("k:TimeStamp/k:when", "", names))
        assert abs((at - ZERO).total_seconds() * 1e6 - float(row["t_us"])) <= 1000
    assert bar.findtext("k:name", "", names) == "bar 0, id 7"
    want = np.array([[float(row[key]) for key in keys[:2]] for row in track])
    np.testing.assert_allclose(np.array(places([way], "LineString"))[:, :2], want, rtol=0, atol=1e-8)


TOPICS = {
    "/fix": "foxglove.LocationFix",
    "/track": "foxglove.LocationFix",
    "/pose": "foxglove.PoseInFrame",
    "/integrity": "google.protobuf.Struct",
    "/scene": "foxglove.SceneUpdate",
    "/frames": "evlcp.Frame",
    "/image": "foxglove.CompressedImage",
    "/regions": "foxglove.ImageAnnotations",
}
"""What `fixes.mcap` has, and as what."""


def test_mcap_is_read_back(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="the extra mcap is not installed")
    from mcap_protobuf.decoder import DecoderFactory
    from scipy.spatial.transform import Rotation

    stream, zero_ns = packets(6), int(ZERO.timestamp()) * 10**9
    registry = Registry.load()
    known: Any = {"plan": PositionPlan((SITE,)), "attitude": ATTITUDE, "clock_zero": ZERO}
    t_us = [5_000, 29_999, 30_000, 40_000, 110_000, 110_001, 110_002]
    events = Events.of(t_us, [8, 8, 7, 4, 9, 9, 1], [8, 8, 3, 4, 5, 5, 2], [1, 1, 0, 1, 1, 0, 1])
    with ResultWriter(tmp_path, LINK, registry, sinks=["mcap"], **known) as results:
        for piece in (events[:4], events[4:5], events[5:]):
            results.events(piece)
        region = Region(0, 1_000.0, 100.0, 200.0, 10.0, 20.0)
        registry.hook.evlcp_stage_finished(stage="regions", value=region, elapsed_s=0.0)
        results.write(stream)
        results.finish(RunEnd("complete"))
    fixes = rows_of(tmp_path / "fixes.csv")
    found: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in TOPICS}
    of_json = SimpleNamespace(decoder_for=lambda encoding, _: json.loads if encoding == "json" else None)
    with (tmp_path / "fixes.mcap").open("rb") as file:
        source = reader.make_reader(file, decoder_factories=[DecoderFactory(), of_json])
        for schema, channel, message, decoded in source.iter_decoded_messages():
            assert schema.name == TOPICS[channel.topic]
            found[channel.topic].append((message.log_time, decoded))
    # Two pictures of 40 ms, of which the last 10 ms are shown: a pixel OFF, then one ON and one of both.
    shots = []
    for at_ns, image in found["/image"]:
        with Image.open(io.BytesIO(image.data)) as picture:
            cells = np.array(picture)
        shots.append((at_ns - zero_ns, {(y, x): cells[y, x] for y, x in np.argwhere(cells).tolist()}))
    assert shots == [(40_000_000, {(3, 7): 1}), (120_000_000, {(2, 1): 2, (5, 9): 3})]
    at_ns, boxes = found["/regions"][0]
    assert at_ns - zero_ns == 40_000_000
    (box,) = boxes.points
    assert [(point.x, point.y) for point in box.points] == [(93, 188), (107, 188), (107, 212), (93, 212)]
    frames_us = [frame.t_us for packet in stream for frame in packet.frames]
    assert [line["t_us"] for _, line in found["/frames"]] == pytest.approx(frames_us, abs=0.01)
    ((_, scene),) = found["/scene"]
    (bar,) = scene.entities
    low, high = bar.lines[0].points
    # 0.96 m of a bar that stands, in axes that begin at its centre.
    assert (low.x, low.y, low.z, high.z) == pytest.approx((0, 0, -0.48, 0.48), abs=1e-6)
    assert bar.texts[0].text == "bar 0, id 7"
    assert len(found["/track"]) == len(fixes)
    of_fix = zip(fixes, found["/integrity"], found["/fix"], found["/pose"], strict=True)
    for row, (_, expected), (at_ns, fix), (_, pose) in of_fix:
        assert expected["misfit"] == pytest.approx(float(row["misfit"]), abs=1e-4)
        assert list(expected["alarms"]) == ["unavailable"]
        assert expected["hpl_m"] is None
        assert at_ns == zero_ns + round(float(row["t_us"]) * 1000)
        assert fix.timestamp.ToNanoseconds() == at_ns
        assert fix.latitude == pytest.approx(float(row["latitude_deg"]), abs=1e-10)
        assert math.sqrt(fix.position_covariance[0]) == pytest.approx(float(row["sigma_east_m"]), abs=6e-5)
        q = pose.pose.orientation
        forward = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()[:, 2]
        heading = math.degrees(math.atan2(forward[0], forward[1])) % 360
        assert abs((heading - float(row["heading_deg"]) + 180) % 360 - 180) < 1e-3
        assert pose.pose.position.z == pytest.approx(float(row["height_m"]) - 54, abs=2e-3)


def test_navsat_is_read_back(tmp_path: Path) -> None:
    """By `mcap` and the types of ROS 2 that `rosbags` brings."""
    reader = pytest.importorskip("mcap.reader", reason="the extra ros is not installed")
    typesys = pytest.importorskip("rosbags.typesys", reason="the extra ros is not installed")
    write(tmp_path, packets(6), PositionPlan((SITE,)), "navsat", clock_zero=ZERO)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with (tmp_path / "navsat.mcap").open("rb") as file:
        source = reader.make_reader(file)
        assert source.get_header().profile == "ros2"
        reported = [
            (schema.name, channel.topic, message.log_time, store.deserialize_cdr(message.data, schema.name))
            for schema, channel, message in source.iter_messages()
        ]
    fixes = rows_of(tmp_path / "fixes.csv")
    places = [one for one in sentences(tmp_path) if one.sentence_type == "GGA"]
    assert {(name, topic) for name, topic, _, _ in reported} == {("sensor_msgs/msg/NavSatFix", "/evlcp/fix")}
    assert len(reported) == len(fixes) > 2
    for row, place, (_, _, at_ns, message) in zip(fixes, places, reported, strict=True):
        assert at_ns == int(ZERO.timestamp()) * 10**9 + round(float(row["t_us"]) * 1000)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == at_ns
        assert message.status.status == 0
        assert message.latitude == pytest.approx(place.latitude, abs=1e-7)
        assert message.longitude == pytest.approx(place.longitude, abs=1e-7)
        assert message.altitude == pytest.approx(place.altitude + float(place.geo_sep), abs=0.1)
        assert message.position_covariance_type == 3
        assert message.position_covariance.reshape(3, 3).diagonal().min() > 0


def test_times_by_pulses(tmp_path: Path) -> None:
    """A second of UTC begins a tenth of a second after the camera's clock."""
    pulses = PulseClock(near=ZERO)
    t_us = [100_000 + round(k * 1_000_040) for k in range(3)]
    pulses.add(Triggers.of(t_us, [0, 0, 0], [1, 1, 1]), 0.0, 0.0)
    write(tmp_path, packets(6), PositionPlan((SITE,)), "kml", "mcap", "navsat", clock_zero=pulses)
    fixes = rows_of(tmp_path / "fixes.csv")
    moved = [one for one in sentences(tmp_path) if one.sentence_type == "RMC"]
    reported = [datetime.combine(one.datestamp, one.timestamp) for one in moved]
    assert len(reported) == len(fixes) > 2
    called_us = [float(row["t_us"]) for row in fixes]
    assert min(called_us) < t_us[0] < max(called_us) < t_us[1]
    for at_us, at in zip(called_us, reported, strict=True):
        # The pulse began a second of UTC; before it, what is known beforehand holds.
        after_s = (at_us - t_us[0] * (at_us >= t_us[0])) * 1e-6
        assert (at.replace(tzinfo=UTC) - ZERO).total_seconds() == pytest.approx(after_s, abs=1.1e-3)
