"""The truth beside a recording: what a file says comes back, and what it cannot mean is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.plugin.hooks import Algorithm
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.sim import Truth, load_scene, read_truth, resolve_scene, truth_from_table, truth_of
from tests.conftest import Brings

WORLD = {"latitude_deg": 35.1, "longitude_deg": 136.9}


def with_revision(role: str, target: str, revision: int) -> Registry:
    """What is installed, and a package whose algorithm has a revision."""
    return Registry.load(Brings(Algorithm(role, "own", target, revision, "a test")))


def plain(truth: Truth) -> dict[str, Any]:
    return json.loads(json.dumps(truth.table))


def test_a_truth_comes_back_from_its_file(tmp_path: Path) -> None:
    bars = [
        {"payload": "messages", "ppm": 30.0},
        {"link": {"air": {"chip_rate_hz": 5000.0}, "modulation": {"id": "wh8"}}, "z_m": 5.0},
        {"led_w_m2": 1e-9, "link": {"bar": {"rows": 48}}},
    ]
    known = truth_of(resolve_scene({"duration_s": 0.1, "t0_us": 5, "world": WORLD, "bars": bars}))
    assert [(bar.payload, bar.lit, bar.link.codebook.clusters) for bar in known.bars] == [
        *(("messages", True, 16), ("symbols", True, 16), ("symbols", False, 8))
    ]
    assert [bar.link.codebook.bits_per_symbol for bar in known.bars] == [6, 4, 6]
    assert [bar.rate_hz for bar in known.bars] == pytest.approx([10_000.3, 5000.0, 10_000.0])
    assert len(known.sites) == 3
    path = tmp_path / "REC.truth.json"
    path.write_text(json.dumps(known.table))
    table = plain(known)
    assert plain(read_truth(path)) == table
    assert sorted(table["links"]) == sorted({bar.link.digest for bar in known.bars})
    assert table["links"][known.bars[1].link.digest]["table"]["air"]["chip_rate_hz"] == 5000.0


def test_chips_of_a_file_are_no_frames(tmp_path: Path) -> None:
    np.save(tmp_path / "chips.npy", np.eye(16, dtype=np.uint8))
    known = truth_of(load_scene("night", {"bars.chips_file": str(tmp_path / "chips.npy")}))
    (bar,) = truth_from_table(plain(known)).bars
    assert (bar.lit, bar.sends_frames, bar.symbols.shape) == (True, False, (0, 10, 16))
    assert plain(known)["bars"][0]["packet_chips"] == 16


def test_a_file_without_a_link_is_of_the_default_link() -> None:
    table = plain(truth_of(load_scene("two-bars", ["duration_s=0.1"])))
    del table["links"]
    for bar in table["bars"]:
        del bar["link"], bar["pilot_every"], bar["payload"]
    assert [bar.link for bar in truth_from_table(table).bars] == [resolve({})] * 2
    air = {"frames_per_packet": 20, "pilot_every": 4}
    other = {"modulation": {"id": "wh8"}, "bar": {"rows": 48}, "air": air}
    known = plain(truth_of(load_scene("night", {"link": other})))
    del known["links"], known["bars"][0]["link"]
    assert truth_from_table(known).bars[0].link == resolve(other)
    del known["bars"][0]["profile"]
    with pytest.raises(InputError, match=r"bars\.0\.profile: missing; expected it, or a link"):
        truth_from_table(known)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("bars", 3, "bars = 3: expected a list"),
        ("t_s", [1.0, 0.5], "t_s = [1.0, 0.5]: expected rising times"),
        ("distance_m", [], "distance_m = []: expected one list a bar, 1"),
        ("distance_m.0", [1.0], "distance_m.0 = [1.0]: expected 50 numbers, one a time of t_s"),
        ("camera_path.attitude_deg", [[1.0], []], "camera_path = {"),
        ("bar_centre_px.0", [[1.0]], "bar_centre_px.0.1: missing"),
        ("bars.0.symbols", [[[1]]], "bars.0.symbols = [[[1]]]: expected packets of 10 frames of 16 symbols"),
        ("bars.0.symbols.1.2.3", 64, "bars.0.symbols.1.2.3 = 64: expected 0 to 63"),
        ("bars.0.link", "abc", "bars.0.link = 'abc': expected the digest of one of the links"),
        ("sites", [{"x": 1}], "sites: bar.0.transmitter_id: missing"),
        ("bars.0.covered", [16], "bars.0.covered = [16]: expected clusters 0 to 15"),
        ("scene.t0_us", 10**400, "expected a finite number"),
    ],
)
def test_what_no_truth_says_is_refused_in_one_line(
    path: str, value: Any, message: str, tmp_path: Path
) -> None:
    table = plain(truth_of(load_scene("night", ["duration_s=0.05"])))
    holder: Any = table
    *above, last = path.split(".")
    for part in above:
        holder = holder[int(part) if part.isdigit() else part]
    holder[int(last) if last.isdigit() else last] = value
    (tmp_path / "t.json").write_text(json.dumps(table))
    with pytest.raises(InputError) as fault:
        read_truth(tmp_path / "t.json")
    assert message in str(fault.value)
    assert str(fault.value).startswith(f"{tmp_path}/t.json: ")
    assert len(str(fault.value).splitlines()) == 1


def test_codes_made_otherwise_here_are_refused() -> None:
    scene = {"duration_s": 0.05, "link": {"modulation": {"id": "own"}}}
    there = with_revision("modulation", "evlcp_wh.modulation:Wh8", 1)
    table = plain(truth_of(resolve_scene(scene, there), registry=there))
    assert plain(truth_from_table(table, there)) == table
    with pytest.raises(InputError, match=r"links.*: not a link here: no modulation algorithm named 'own'"):
        truth_from_table(table)
    here = with_revision("modulation", "evlcp_wh.modulation:Raw8", 2)
    with pytest.raises(InputError) as fault:
        truth_from_table(table, here, source="t.json")
    assert "its settings give" in str(fault.value)
    assert "(revisions: modulation own 1 there, 2 here); install the versions" in str(fault.value)


def test_another_revision_with_the_same_codes_is_a_warning() -> None:
    scene = {"duration_s": 0.05, "link": {"ranging": {"id": "own"}}}
    there, here = (with_revision("ranging", "evlcp_poc.ranging:PocRanging", revision) for revision in (1, 2))
    table = plain(truth_of(resolve_scene(scene, there), registry=there))
    assert truth_from_table(table, there).warnings == ()
    (warning,) = truth_from_table(table, here, source="t.json").warnings
    assert warning.startswith("t.json: links.")
    assert "(revisions: ranging own 1 there, 2 here); the codes are the same" in warning
