"""Each value of a link once wrong: taken, or refused in a line that names it."""

import math
from collections.abc import Mapping
from typing import Any

import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.plugin.registry import Registry

ONE_LED = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
WRONG: tuple[Any, ...] = (-1, 0, "x", 1e300, math.nan, math.inf, [], {}, True, 10**30)


def complaint(link: Mapping[str, Any], section: str, key: str, value: Any, registry: Registry) -> str:
    """What is said of a value; empty where it is taken."""
    table = {name: dict(part) for name, part in link.items()}
    table.setdefault(section, {})[key] = value
    try:
        resolve(table, registry=registry)
    except ConfigError as error:
        return str(error)
    return ""


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
                said = complaint(link, section, key, value, registry)
                tried, refused = tried + 1, refused + bool(said)
                named = f"no {section} algorithm named" if (key, value) == ("id", "x") else key
                # One line; of a list, one for each of its values.
                assert all(named in line for line in said.splitlines()), (section, key, value)
                if isinstance(value, float) and not math.isfinite(value):
                    assert said, (section, key, value)
    assert refused > tried / 2
