"""Several links at a receiver: their settings, which are alike; and what two ends of one must share."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.cli._receiving import LinkOptions
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.link.several import alike_links, load_links, named_links
from evlcp_sdk.link.shared import differences
from evlcp_sdk.plugin.registry import Registry


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
    with pytest.raises(
        ConfigError, match=r"^--set fra\.ranging\.id=poc: no link is named 'fra': .* bar, far"
    ):
        load_links(files, ["fra.ranging.id=poc"])


ONE_LED = "[bar]\nrows = 6\ncolumns = 1\ncluster_rows = 6\ncluster_columns = 1\n"
TOLD = '[air]\nchip_rate_hz = {rate}\n[framing]\nid = "uart"\n'


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
def test_links_whose_characters_the_other_reads_are_named(tmp_path, rate, settings, alike) -> None:
    (tmp_path / "lamp.toml").write_text(ONE_LED + TOLD.format(rate=3125.0))
    (tmp_path / "other.toml").write_text(ONE_LED + TOLD.format(rate=rate) + settings)
    (tmp_path / "bar.toml").write_text("")
    links = named_links(load_links([tmp_path / f"{name}.toml" for name in ("bar", "lamp", "other")]))
    assert alike_links(links) == [("lamp", "other")] * alike


def test_links_alike_are_said_on_stderr_before_anything_is_read(tmp_path, capsys) -> None:
    for name, idle in (("lamp", ""), ("off", "idle = 'off'")):
        (tmp_path / f"{name}.toml").write_text(ONE_LED + TOLD.format(rate=3125.0) + idle)
    files = [str(tmp_path / "lamp.toml"), str(tmp_path / "off.toml")]
    LinkOptions(files).load(Registry.load())
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("evlcp: warning: what one of the links 'lamp' and 'off' sends, the other may read")
    LinkOptions(files[:1]).load(Registry.load())
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({}, ()),
        ({"decoding": {"id": "ml-soft"}, "camera": {"focal_mm": 50.0}, "regions": {"fade_us": 30_000}}, ()),
        ({"air": {"chip_rate_hz": 5000.0}}, ("air.chip_rate_hz: sent with 5000.0, received with 10000.0",)),
        (
            {"air": {"frames_per_packet": 20, "pilot_every": 4}},
            (
                "air.frames_per_packet: sent with 20, received with 10",
                "air.pilot_every: sent with 4, received with 1",
            ),
        ),
        ({"modulation": {"id": "wh8"}}, ('modulation.id: sent with "wh8", received with "wh4x2"',)),
        ({"pilots": {"id": "barker13"}}, ('pilots.id: sent with "barker13", received with "wh"',)),
        ({"bar": {"rows": 48}}, ("bar.rows: sent with 48, received with 96",)),
        ({"bar": {"led_pitch_m": 0.02}}, ("bar.led_pitch_m: sent with 0.02, received with 0.01",)),
        ({"bar": {"rows": 16, "cluster_rows": 1, "led_pitch_m": 0.06}}, ()),
        (
            {"bar": {"rows": 16, "columns": 16, "cluster_rows": 4, "cluster_columns": 4}},
            (
                "bar.rows: sent with 16, received with 96",
                "bar.columns: sent with 16, received with 1",
                "bar.cluster_rows: sent with 4, received with 6",
                "bar.cluster_columns: sent with 4, received with 1",
            ),
        ),
        ({"error-correction": {"id": "reed-solomon"}}, ()),
    ],
)
def test_what_differs_is_named(table: dict[str, Any], says: tuple[str, ...]) -> None:
    assert differences(resolve(table), resolve({})) == says


def test_the_error_correction_counts_where_messages_are_sent() -> None:
    sent = resolve({"error-correction": {"id": "reed-solomon"}})
    says = ('error-correction.id: sent with "reed-solomon", received with "polar"',)
    assert differences(sent, resolve({}), messages=True) == says
    slow = resolve({"error-correction": {"id": "polar", "rate": 0.25}})
    (one,) = differences(slow, resolve({}), messages=True)
    assert one.startswith("error-correction.rate: sent with 0.25, received with ")


def test_settings_of_the_decoder_alone_may_differ() -> None:
    sent = resolve({"error-correction": {"id": "polar", "list_size": 4}})
    assert differences(sent, resolve({}), messages=True) == ()


def test_another_revision_is_named() -> None:
    link, other = resolve({}), resolve({"modulation": {"id": "wh8"}})
    codes = replace(link.codebook, codewords=other.codebook.codewords)
    newer = replace(link, codebook=codes, revisions={**link.revisions, "modulation": 9}, digest="0")
    says = ('modulation.id = "wh4x2": sent with revision 9, received with revision 1',)
    assert differences(newer, link) == says


def test_codes_that_differ_in_silence_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from evlcp_wh.pilots import WhPilots

    ours = resolve({})
    codes = WhPilots.codes
    monkeypatch.setattr(WhPilots, "codes", lambda self, clusters: codes(self, clusters)[::-1].copy())
    theirs = resolve({})
    assert not np.array_equal(ours.codebook.pilots, theirs.codebook.pilots)
    (says,) = differences(ours, theirs)
    assert says == 'pilots.id = "wh": sent with other codes than those received with'


def test_a_link_survives_pickling_and_is_equal_by_its_digest() -> None:
    link = resolve({"modulation": {"id": "wh8"}})
    again: Link = pickle.loads(pickle.dumps(link))
    assert again == link
    assert len({again, link, resolve({})}) == 2
    assert again.codebook == link.codebook
    assert again.block_coder().block_bytes == link.block_coder().block_bytes
