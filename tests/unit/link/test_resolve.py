"""link.toml: what is refused and how it is said, overrides, the digest, and the commented text."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.link.text import to_toml
from evlcp_sdk.plugin.hooks import Algorithm
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES, Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from tests.conftest import Brings
from tests.unit.mutants import refusal


@dataclass(frozen=True)
class FakeRanging(Ranging):
    """Distance out of thin air."""

    min_spacing: Annotated[int, Field(ge=1, le=15, description="Clusters between the two of a pair.")] = 8
    window_px: Annotated[float, Field(gt=0, description="Half width of the fit.")] = 2
    kernel: Annotated[Literal["sinc", "gauss"], Field(description="What is fitted.")] = "sinc"
    drop: Annotated[tuple[int, ...], Field(description="Clusters left out.")] = (0, 15)
    trim: bool = True
    limit_m: Annotated[float | None, Field(description="Farthest distance told.")] = None

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        raise NotImplementedError


def fakes(revision: int = 1) -> Brings:
    """The defaults of each role, a fake for ranging among them, and another one."""
    installed, fake = Registry.load(), f"{__name__}:FakeRanging"
    others = set(ROLES.values()) - {ROLES["ranging"]}
    return Brings(
        *(installed.find(role.name, role.default).algorithm for role in others),
        Algorithm("ranging", ROLES["ranging"].default, fake, revision, "a fake"),
        Algorithm("ranging", "centroid", fake, 3, "another fake"),
    )


@pytest.fixture
def registry() -> Registry:
    return Registry(fakes())


def faults_of(registry: Registry, text: str, tmp_path: Path, *overrides: str) -> list[str]:
    path = tmp_path / "link.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_link(path, overrides, registry)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(f"{tmp_path}/", "").splitlines()


TABLES = [
    *("camera", "camera_sigma", "bar", "air", "regions", "messages", "position", "detection", "framing"),
    *("pilots", "modulation", "synchronization", "separation", "decoding", "ranging", "tracking"),
    "error-correction",
]


def test_defaults_are_all_written_out(registry: Registry) -> None:
    link = load_link(None, (), registry)
    assert list(link.table) == TABLES
    assert link.table["air"] == {"chip_rate_hz": 10_000.0, "frames_per_packet": 10, "pilot_every": 1}
    own = {"min_spacing": 8, "window_px": 2.0, "kernel": "sinc", "drop": [0, 15], "trim": True}
    assert link.table["ranging"] == {"id": "joint-scale", **own, "limit_m": None}
    assert link.algorithm("ranging") == FakeRanging()
    assert link.packet.packet_chips == 346
    assert json.loads(json.dumps(link.table)) == link.table


@pytest.mark.parametrize("override", ["ranging", "ranging.id", "=3", "ranging=3", ".id=3", "ranging.=3"])
def test_an_override_of_another_form(registry: Registry, override: str) -> None:
    with pytest.raises(ConfigError, match=r"^--set .*: expected table\.key=value, e\.g\."):
        load_link(None, [override], registry)


def test_every_fault_of_a_file_is_reported(registry: Registry, tmp_path: Path) -> None:
    text = """
    camra.width = 3
    decoding = 4
    [camera]
    width = 0
    focal_mm = "35"
    [air]
    frames_per_packet = 2.5
    [modulation]
    id = 8
    [regions]
    step_us = "slow"
    [ranging]
    min_spaceing = 9
    min_spacing = 16
    trim = 1
    kernel = "sink"
    window_px = nan
    """
    known = f"(known: {', '.join(TABLES)})"
    assert faults_of(registry, text, tmp_path, "bar.led_pitch_m=-1", "lamp.on=1", "pilots.id=hw") == [
        f"link.toml: camra: unknown table; did you mean 'camera'? {known}",
        "link.toml: decoding = 4: expected a table",
        f"--set: lamp.on: unknown table {known}",
        "link.toml: camera.width = 0: expected greater than 0",
        'link.toml: camera.focal_mm = "35": expected a valid number',
        "--set: bar.led_pitch_m = -1: expected greater than or equal to 0.000001",
        "link.toml: air.frames_per_packet = 2.5: expected a valid integer",
        'link.toml: regions.step_us = "slow": expected a valid integer',
        "no pilots algorithm named 'hw' (installed: wh)",
        "link.toml: modulation.id = 8: expected a string",
        "link.toml: ranging.min_spacing = 16: expected less than or equal to 15",
        "link.toml: ranging.window_px = nan: expected a finite number",
        "link.toml: ranging.kernel = \"sink\": expected 'sinc' or 'gauss'",
        "link.toml: ranging.trim = 1: expected a valid boolean",
        "link.toml: ranging.min_spaceing = 9: unknown key; did you mean 'min_spacing'?"
        " (known: min_spacing, window_px, kernel, drop, trim, limit_m)",
    ]


def test_the_digest_holds_table_codebook_and_revisions(registry: Registry) -> None:
    digest = load_link(None, (), registry).digest
    assert len(digest) == 64
    for override in ("ranging.min_spacing=8", "camera.focal_mm=35"):
        assert load_link(None, [override], registry).digest == digest
        assert load_link(None, override, registry).digest == digest
    for override in ("ranging.min_spacing=9", "ranging.id=centroid"):
        assert load_link(None, [override], registry).digest != digest
    assert load_link(None, (), Registry(fakes(revision=2))).digest != digest


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["ranging.limit_m=120", "ranging.drop=[]", 'ranging.kernel="gauss"', "ranging.window_px=1e-7"],
        ["ranging.id=centroid", "camera.k3=1e-17", "air.chip_rate_hz=12500"],
    ],
)
def test_the_commented_text_gives_the_same_link(registry, tmp_path, overrides) -> None:
    link = load_link(None, overrides, registry)
    path = tmp_path / "link.toml"
    path.write_text(to_toml(link, registry))
    again = load_link(path, (), registry)
    assert (again.digest, again.table) == (link.digest, link.table)
    assert to_toml(again, registry) == path.read_text()


def test_the_text_tells_meaning_unit_bounds_and_default(registry: Registry) -> None:
    lines = to_toml(load_link(None, ["ranging.window_px=3"], registry), registry).splitlines()
    i = lines.index("[ranging]")
    assert lines[i - 1 : i + 6] == [
        "# Distance out of thin air.",
        "[ranging]",
        'id = "joint-scale"  # or centroid',
        "# Clusters between the two of a pair. [>= 1, <= 15, default 8]",
        "min_spacing = 8",
        "# Half width of the fit. [px, > 0, default 2.0]",
        "window_px = 3.0",
    ]
    assert '# What is fitted. ["sinc" | "gauss", default "sinc"]' in lines
    assert "# Farthest distance told. [m, default none]" in lines


ONE_LED = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
WRONG: tuple[Any, ...] = (-1, 0, "x", 1e300, math.nan, math.inf, [], {}, True, 10**30)


@pytest.mark.parametrize(
    ("link", "sections"),
    # The table has every parameter, new ones, too; of characters, what the link of packets has not.
    [({}, list(resolve({}).table)), ({"bar": ONE_LED, "framing": {"id": "uart"}}, ["framing", "detection"])],
    ids=["packets", "uart"],
)
def test_a_wrong_value_is_refused_by_its_name(link: Mapping[str, Any], sections: list[str]) -> None:
    registry = Registry.load()
    tried = refused = 0
    table = resolve(link, registry=registry).table
    for section in sections:
        for key in table[section]:
            for value in WRONG:
                changed = {**link, section: {**link.get(section, {}), key: value}}
                reported = refusal(lambda: resolve(changed, registry=registry)) or ""  # noqa: B023
                tried, refused = tried + 1, refused + bool(reported)
                named = f"no {section} algorithm named" if (key, value) == ("id", "x") else key
                # One line; of a list, one for each of its values.
                assert all(named in line for line in reported.splitlines()), (section, key, value)
                if isinstance(value, float) and not math.isfinite(value):
                    assert reported, (section, key, value)
    assert refused > tried / 2
