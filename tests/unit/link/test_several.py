"""Several links at a receiver: their settings, which are alike; and what two ends of one must share."""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.cli._receiving import LinkOptions
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.link.several import find_ambiguous_links, load_links, name_links
from evlcp_sdk.link.shared import find_differences


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    (tmp_path / "bar.toml").write_text("")
    (tmp_path / "far.toml").write_text('[modulation]\nid = "wh8"\n')
    return [tmp_path / "bar.toml", tmp_path / "far.toml"]


def test_a_setting_changes_all_links_or_the_one_that_it_names(files: list[Path]) -> None:
    bar, far = load_links(files, ["ranging.id=poc", "far.ranging.id = centroid", "bar.ranging.skip_outer=0"])
    assert bar.table["ranging"]["id"] == "poc"
    assert bar.table["ranging"]["skip_outer"] == 0
    assert far.table["ranging"]["id"] == "centroid"
    (alone,) = load_links(files[1:], ["ranging.id=poc"])
    assert alone.table["ranging"]["id"] == "poc"


def test_a_setting_of_no_link_is_refused(files: list[Path]) -> None:
    message = r"^--set fra\.ranging\.id=poc: no link is named 'fra': .* bar, far"
    with pytest.raises(ConfigError, match=message):
        load_links(files, ["fra.ranging.id=poc"])


LAMP = """
[bar]
rows = 6
columns = 1
cluster_rows = 6
cluster_columns = 1
[framing]
id = "uart"
"""


@pytest.mark.parametrize(
    ("rate", "settings", "alike"),
    [
        (3125.0, "idle = 'off'", True),
        (3160.0, "", True),
        (3300.0, "", False),
        (3125.0, "parity = 'even'", False),
        (3125.0, "data_bits = 7\nparity = 'even'", True),
        (3125.0, "data_bits = 7\nparity = 'even'\nidle = 'off'", True),
        (3125.0, "stop_bits = 2", True),
        (3125.0, "data_bits = 7", False),
        (3125.0, "pause_bits = 40", True),
    ],
    ids=str,
)
def test_links_whose_characters_the_other_reads_are_named(tmp_path, capsys, rate, settings, alike) -> None:
    air = "[air]\nchip_rate_hz = "
    for name, text in (
        ("bar", ""),
        ("lamp", f"{LAMP}{air}3125.0"),
        ("other", f"{LAMP}{settings}\n{air}{rate}"),
    ):
        (tmp_path / f"{name}.toml").write_text(text)
    files = [tmp_path / f"{name}.toml" for name in ("bar", "lamp", "other")]
    assert find_ambiguous_links(name_links(load_links(files))) == [("lamp", "other")] * alike
    # It is said on stderr before anything is read.
    LinkOptions([*map(str, files)]).load()
    message = "evlcp: warning: what one of the links 'lamp' and 'other' sends, the other may read"
    assert [line.startswith(message) for line in capsys.readouterr().err.splitlines()] == [True] * alike


@pytest.mark.parametrize(
    ("table", "keys"),
    [
        ({}, {}),
        ({"decoding": {"id": "ml-soft"}, "camera": {"focal_mm": 50.0}, "regions": {"fade_us": 30_000}}, {}),
        ({"air": {"chip_rate_hz": 5000.0}}, {"air.chip_rate_hz": 10000.0}),
        (
            {"air": {"frames_per_packet": 20, "pilot_every": 4}},
            {"air.frames_per_packet": 10, "air.pilot_every": 1},
        ),
        ({"modulation": {"id": "wh8"}}, {"modulation.id": "wh4x2"}),
        ({"pilots": {"id": "barker13"}}, {"pilots.id": "wh"}),
        ({"bar": {"rows": 48}}, {"bar.rows": 96}),
        ({"bar": {"led_pitch_m": 0.02}}, {"bar.led_pitch_m": 0.01}),
        ({"bar": {"rows": 16, "cluster_rows": 1, "led_pitch_m": 0.06}}, {}),
        (
            {"bar": {"rows": 16, "columns": 16, "cluster_rows": 4, "cluster_columns": 4}},
            {"bar.rows": 96, "bar.columns": 1, "bar.cluster_rows": 6, "bar.cluster_columns": 1},
        ),
        # The error correction counts where messages are sent, what is set of its decoder alone does not.
        ({"error-correction": {"id": "reed-solomon"}}, {"error-correction.id": "polar"}),
        ({"error-correction": {"id": "polar", "rate": 0.25}}, {"error-correction.rate": 0.5}),
        ({"error-correction": {"id": "polar", "list_size": 4}}, {}),
    ],
)
def test_what_differs_is_named(table: dict[str, Any], keys: dict[str, Any]) -> None:
    sent, ours = resolve(table), resolve({})

    def named(key: str) -> str:
        section, name = key.split(".")
        return f"{key}: sent with {json.dumps(table[section][name])}, received with {json.dumps(keys[key])}"

    messages = "error-correction" in table
    assert find_differences(sent, ours, messages=messages) == tuple(map(named, keys))
    assert not messages or find_differences(sent, ours) == ()


def test_another_revision_is_named() -> None:
    link, other = resolve({}), resolve({"modulation": {"id": "wh8"}})
    codes = replace(link.codebook, codewords=other.codebook.codewords)
    newer = replace(link, codebook=codes, revisions={**link.revisions, "modulation": 9}, digest="0")
    reported = ('modulation.id = "wh4x2": sent with revision 9, received with revision 1',)
    assert find_differences(newer, link) == reported


def test_codes_that_differ_in_silence_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from evlcp_wh.pilots import WhPilots

    ours = resolve({})
    codes = WhPilots.codes
    monkeypatch.setattr(WhPilots, "codes", lambda self, clusters: codes(self, clusters)[::-1].copy())
    theirs = resolve({})
    assert not np.array_equal(ours.codebook.pilots, theirs.codebook.pilots)
    (result,) = find_differences(ours, theirs)
    assert result == 'pilots.id = "wh": sent with other codes than those received with'


def test_a_link_survives_pickling_and_is_equal_by_its_digest() -> None:
    link = resolve({"modulation": {"id": "wh8"}})
    again: Link = pickle.loads(pickle.dumps(link))
    assert again == link
    assert len({again, link, resolve({})}) == 2
    assert again.codebook == link.codebook
    assert again.block_coder().block_bytes == link.block_coder().block_bytes
