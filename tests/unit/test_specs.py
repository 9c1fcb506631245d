"""A table against a nested dataclass: each fault with its path, its value, what was expected."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import pytest
from pydantic import Field

from evlcp_sdk.errors import ConfigError, name_place
from evlcp_sdk.specs import SpecError, build_spec, parse_toml, parse_value, read_toml


@dataclass(frozen=True)
class Inner:
    width_m: Annotated[float, Field(gt=0)] = 1.0
    name: Annotated[str, Field(pattern="^[a-z]+$")] = "x"


@dataclass(frozen=True)
class Outer:
    count: int
    inner: Inner = field(default_factory=Inner)
    rows: tuple[Inner, ...] = ()
    maybe: Inner | None = None
    either: str | dict[str, Any] = ""

    def __post_init__(self) -> None:
        if self.count == 13:
            raise ConfigError("count = 13: expected another")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "count: missing"),
        ({"iner": {}}, "iner: unknown table; did you mean 'inner'? (known: count, inner,"),
        ({"rows": {}}, "rows: expected a list"),
        ({"rows": [{}, {"width_m": -1}]}, "rows.1.width_m = -1: expected greater than 0"),
        ({"rows": [{"nam": "y"}]}, "rows.0.nam = \"y\": unknown key; did you mean 'name'?"),
        ({"maybe": {"nam": "y"}}, "maybe.nam = \"y\": unknown key; did you mean 'name'?"),
        ({"inner": {"name": "X"}}, 'inner.name = "X": expected to match pattern'),
        ({"either": 3}, "either = 3: expected a valid string or a table"),
    ],
)
def test_a_fault_is_one_line_with_path_value_and_what_was_expected(table, message) -> None:
    with pytest.raises(ConfigError) as caught, name_place("f.toml: "):
        build_spec(Outer, {"count": 1} | table if table else {})
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"f.toml: {message}")
    assert caught.value.exit_code == 2


def test_what_the_dataclass_refuses_passes_and_a_hint_stands_for_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"^count = 13: expected another"):
        build_spec(Outer, {"count": 13})
    with pytest.raises(SpecError, match=r"^rows\.0\.wide = 3: unknown key; see width$"):
        build_spec(Outer, {"count": 1, "rows": [{"wide": 3}]}, hint=lambda path: f"; see {path[-1][:3]}th")


@pytest.mark.parametrize("digits", ["9" * 5000, "0x" + "f" * 5000, "9223372036854775808"])
def test_an_integer_beyond_64_bits_is_a_line(digits: str) -> None:
    for text in (f"a = {digits}", f"a = [[{{b = {digits}}}]]"):
        with pytest.raises(ConfigError, match=r"^here: not TOML: an integer beyond 64 bits$"):
            parse_toml(text, "here")
    assert parse_value(digits) == digits
    with pytest.raises(SpecError) as caught:
        build_spec(Outer, {"count": parse_value(digits)})
    (line,) = str(caught.value).splitlines()
    assert len(line) < 250
    assert line.endswith(": expected a valid integer")


def test_a_byte_order_mark_and_lines_behind_a_value_lose_nothing(tmp_path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfb = 3\r\n")
    assert read_toml(tmp_path / "a.toml") == {"b": 3}
    assert parse_value("50\ncamera.width = 3") == "50\ncamera.width = 3"
