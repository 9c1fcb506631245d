"""Tables of figures: nothing is cut, on a narrow screen or in a pipe."""

import io
import re

import pytest
from rich.console import Console

from evlcp_sdk.cli._tables import print_table

HEAD = ["series", "distance", *(f"figure {i}" for i in range(9))]
ROWS = [[(f"{name} {i}", i == 4) for i in range(11)] for name in ("one bar", "two bars")]


@pytest.mark.parametrize(("width", "terminal", "parts"), [(60, True, 4), (5000, True, 1), (80, False, 1)])
def test_all_columns_are_there_and_each_part_says_of_what(width: int, terminal: bool, parts: int) -> None:
    out = io.StringIO()
    screen = Console(file=out, force_terminal=terminal, width=width, no_color=True, soft_wrap=True)
    print_table(screen, HEAD, ROWS, names=2)
    told = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())
    assert all(f"{name} {i}" in told for name in ("one bar", "two bars") for i in range(11))
    assert "…" not in told
    assert told.count("one bar 1") == parts + 1  # "one bar 10" begins so, too.
    assert told.count("one bar 0") == parts
    assert not terminal or max(map(len, told.splitlines())) <= width


def test_a_name_longer_than_the_screen_cuts_no_figure() -> None:
    out, name = io.StringIO(), "".join(chr(97 + i % 26) for i in range(60))
    screen = Console(file=out, width=40, force_terminal=True, no_color=True)
    print_table(
        screen, ["series", "positions", "NEES"], [[(name, False), ("288 of 288", False), ("2.58", True)]]
    )
    told = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())
    assert "288 of 288" in told
    assert "2.58" in told
    first = told[: told.index("positions")] + told[told.index("positions") : told.index("NEES")]
    assert "".join(re.findall(r"^[a-z]+(?= |$)", first, re.M)).replace("series", "") == name
    assert max(map(len, told.splitlines())) <= 40
