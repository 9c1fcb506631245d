"""Several links of one receiver: which settings each takes, and what they cannot be."""

from pathlib import Path

import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.several import load_links


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
