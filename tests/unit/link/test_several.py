"""Several links of one receiver: which settings each takes, and what they cannot be."""

from pathlib import Path

import pytest

from evlcp_sdk.cli._receiving import LinkOptions
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.several import alike_links, load_links, named_links
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
def test_links_whose_characters_the_other_reads_are_named(
    tmp_path: Path, rate: float, settings: str, alike: bool
) -> None:
    (tmp_path / "lamp.toml").write_text(ONE_LED + TOLD.format(rate=3125.0))
    (tmp_path / "other.toml").write_text(ONE_LED + TOLD.format(rate=rate) + settings)
    (tmp_path / "bar.toml").write_text("")
    links = named_links(load_links([tmp_path / f"{name}.toml" for name in ("bar", "lamp", "other")]))
    assert alike_links(links) == [("lamp", "other")] * alike


def test_links_alike_are_said_on_stderr_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, idle in (("lamp", ""), ("off", "idle = 'off'")):
        (tmp_path / f"{name}.toml").write_text(ONE_LED + TOLD.format(rate=3125.0) + idle)
    files = [str(tmp_path / "lamp.toml"), str(tmp_path / "off.toml")]
    LinkOptions(files).load(Registry.load())
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("evlcp: warning: what one of the links 'lamp' and 'off' sends, the other may read")
    LinkOptions(files[:1]).load(Registry.load())
    assert not capsys.readouterr().err
