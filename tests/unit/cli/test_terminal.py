"""What names, files and plugins say moves no cursor, on a terminal as elsewhere; and no table is cut."""

import logging
import os
import pty
import re
import subprocess
import sys
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from evlcp_sdk.cli._common import log_on_stderr
from evlcp_sdk.cli._tables import print_table
from evlcp_sdk.formatting import escape_controls
from evlcp_sdk.io import write_events
from evlcp_sdk.values import Events

TITLE = "\x1b]0;mine\x07\x9b31m\u202e"
COMMAND = "from evlcp_sdk.cli.main import main; main()"


def on_a_terminal(*arguments: str, **environment: str) -> str:
    """Run a command on a terminal without colours; all that it shows."""
    inside, outside = pty.openpty()
    run = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=outside,
        stderr=outside,
        env=os.environ | {"TERM": "dumb", "NO_COLOR": "1", "PYTHONUTF8": "1"} | environment,
    )
    os.close(outside)
    shown = b""
    # At the end of a terminal, reading fails.
    with suppress(OSError):
        while piece := os.read(inside, 1 << 16):
            shown += piece
    os.close(inside)
    run.wait()
    return shown.decode("utf-8")


def test_control_characters_are_escapes_and_the_rest_is_as_it_is() -> None:
    assert escape_controls("a\tb\nä 光 [bold]") == "a\tb\nä 光 [bold]"
    assert escape_controls(TITLE) == r"\x1b]0;mine\x07\x9b31m\u202e"
    assert escape_controls("\udcff\r\x7f") == r"\udcff\x0d\x7f"


@pytest.mark.parametrize("what", ["receive", "missing", "option", "config"])
def test_no_control_character_reaches_a_terminal(what: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{TITLE}.raw"
    write_events(path, Events.of(np.arange(5), *np.ones((3, 5), np.int64)), 1280, 720)
    (tmp_path / "link.toml").write_text('[air]\n"chip\\u001b[31m" = 5\n')
    arguments = {
        "receive": ("receive", str(path), "-o", str(tmp_path / f"out{TITLE}")),
        "missing": ("info", str(tmp_path / f"b{TITLE}.raw")),
        "option": ("info", f"--{TITLE}", str(path)),
        "config": ("config", "-c", str(tmp_path / "link.toml")),
    }[what]
    shown = on_a_terminal(*arguments)
    assert r"\x1b" in shown
    assert not {c for c in shown if c not in "\r\n\t" and (ord(c) < 0x20 or 0x7F <= ord(c) < 0xA0)}, shown
    assert "\u202e" not in shown


def test_the_status_of_a_live_run_is_shown_whole(demo_raw: Path, tmp_path: Path) -> None:
    arguments = ("live", f"replay:{demo_raw}?speed=0.1", "-o", str(tmp_path))
    shown = " ".join(on_a_terminal(*arguments, TERM="xterm", COLUMNS="30").split())
    assert re.search(r"Mev/s, \d+ frames?, delay p50 \S+, p99 \S+, max \S+ ms", shown)


def test_commands_print_by_the_one_way_only() -> None:
    root = Path(__file__).parents[3]
    files = [*root.glob("evlcp_sdk/cli/*.py"), *root.glob("firmware_host/commands/*.py")]
    assert len(files) > 20
    for path in files:
        text = path.read_text()
        if path.name == "_common.py":
            continue
        others = [name for name in ("typer.echo(", " Console(", "=Console(", " print(") if name in text]
        assert not others, path


def test_the_log_is_on_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    with log_on_stderr():
        logging.getLogger("evlcp_sdk.kernels").info("compiling\x1b")
    logging.getLogger("evlcp_sdk.kernels").info("not said")
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "evlcp: compiling\\x1b\n")


def table_of(head: list[str], rows: list[list[str]], names: int = 1, **screen: Any) -> str:
    """A table as it is shown, without its colours."""
    out = StringIO()
    print_table(Console(file=out, no_color=True, **screen), head, rows, names)
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())


@pytest.mark.parametrize(("width", "terminal", "parts"), [(60, True, 4), (5000, True, 1), (80, False, 1)])
def test_all_columns_are_there_and_each_part_says_of_what(width: int, terminal: bool, parts: int) -> None:
    head = ["series", "distance", *(f"figure {i}" for i in range(9))]
    rows = [[f"{name} {i}" for i in range(11)] for name in ("one bar", "two bars")]
    reported = table_of(head, rows, names=2, force_terminal=terminal, width=width, soft_wrap=True)
    assert all(cell in reported for row in rows for cell in row)
    assert "…" not in reported
    assert reported.count("one bar 1") == parts + 1  # "one bar 10" begins so, too.
    assert reported.count("one bar 0") == parts
    assert not terminal or max(map(len, reported.splitlines())) <= width
