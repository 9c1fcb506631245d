"""Files read and written whole."""

import csv
import io
import json
import os
import re
import stat
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from evlcp_sdk.errors import ConfigError, InputError, OutputError
from evlcp_sdk.files import (
    Outputs,
    check_columns,
    escape_formula,
    open_log,
    read_csv,
    read_json,
    write_secret,
)
from evlcp_sdk.specs import read_toml

READERS = read_toml, read_csv, read_json
UNREADABLE = [
    (read_toml, "a.toml", b"a = \n", r"a\.toml: not TOML: Invalid value \(at line 1"),
    (read_toml, "a.toml", b"a = '\xff'\n", r"a\.toml: at byte 5: not UTF-8 text"),
    (read_toml, "a.toml", b"a = " + 2000 * b"[", r"a\.toml: not TOML: "),
    (read_csv, "a.csv", b"a\n\xff\n", r"a\.csv: not a CSV file: "),
    (read_csv, "a.csv", b'a,b\n"' + 140_000 * b"x" + b'",1\n', r"a\.csv: not a CSV file: "),
    (read_csv, "a.csv", b"t_s,x_m,x_m\n1,2,3\n", r"a\.csv: line 1: 2 columns x_m: expected one"),
    (read_csv, "a.csv", b"t_s,name\n1,a\n\n2\n", r"a\.csv: line 4: 1 fields, expected 2, as line 1 has"),
    (read_json, "a.json", b"{", r"a\.json: not JSON: "),
    (read_json, "a.json", 200_000 * b"[", r"a\.json: not JSON: "),
    *((read, "gone", None, "gone: cannot be read: No such file") for read in READERS),
    *((read, ".", None, "cannot be read: Is a directory") for read in READERS),
]


@pytest.mark.parametrize(("read", "name", "content", "message"), UNREADABLE)
def test_what_cannot_be_read_is_one_line(read, name, content, message, tmp_path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises((ConfigError, InputError), match=message) as caught:
        read(tmp_path / name)
    assert "\n" not in str(caught.value)


def write_text(text: str, path: Path) -> None:
    with Outputs() as outputs:
        outputs.write_text(text, path)


def test_an_earlier_file_stays_until_the_new_one_is_whole(tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.txt"
    write_text("old", path)
    with suppress(KeyError), Outputs() as outputs:
        outputs.path(path).write_text("half")
        raise KeyError
    assert path.read_text() == "old"
    with Outputs() as outputs:
        outputs.path(path).write_text("new")
        assert path.read_text() == "old"
    # A death just before it comes into place leaves the earlier one, too.
    monkeypatch.setattr(Path, "replace", Mock(side_effect=KeyboardInterrupt))
    with suppress(KeyboardInterrupt):
        write_text("newer", path)
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_was_committed_before_the_end_of_the_block_stays(tmp_path: Path) -> None:
    with Outputs() as outputs:
        outputs.write_text("one", tmp_path / "a")
        outputs.commit()
        assert (tmp_path / "a").read_text() == "one"
        outputs.write_text("two", tmp_path / "b")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "one", "b": "two"}


def test_hidden_places_cannot_be_known_before(tmp_path: Path) -> None:
    """Who plants links under the names that a process would use reaches nothing."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / f".a.txt.{os.getpid()}.part").symlink_to(victim)
    write_text("x", tmp_path / "a.txt")
    assert victim.read_text() == "mine"
    stages = set()
    for _ in range(20):
        with Outputs() as outputs:
            stage = outputs.path(tmp_path / "a.txt").parent
            assert stat.S_IMODE(stage.stat().st_mode) == 0o700
            assert stage.parent == tmp_path
            stages.add(stage)
    assert len(stages) == 20
    assert not any(stage.exists() for stage in stages)


@pytest.mark.parametrize("dangling", [False, True])
def test_links_are_neither_followed_nor_replaced(tmp_path: Path, dangling: bool) -> None:
    victim, link = tmp_path / "victim", tmp_path / "a.txt"
    if not dangling:
        victim.write_text("mine")
    link.symlink_to(victim)
    for write in (lambda: write_text("x", link), lambda: open_log(link)):
        with pytest.raises(OutputError, match=r"a\.txt: cannot be written: it is a link; name the file"):
            write()
    assert link.is_symlink()
    assert victim.exists() is not dangling
    with pytest.raises(OutputError, match=r"a\.txt: exists; a key is not overwritten"):
        write_secret(b"x", link)
    outputs = Outputs()
    outputs.write_text("x", tmp_path / "b.txt")
    (tmp_path / "b.txt").symlink_to(victim)
    with pytest.raises(OutputError, match=r"b\.txt: cannot be written: it is a link"):
        outputs.commit()
    outputs.discard()
    assert (tmp_path / "b.txt").is_symlink()
    assert dangling or victim.read_text() == "mine"


def test_a_pipe_is_written_and_stays(tmp_path: Path) -> None:
    pipe, reported = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: reported.append(pipe.read_text()))
    reader.start()
    write_text("through", pipe)
    reader.join(10)
    assert reported == ["through"]
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    assert list(tmp_path.iterdir()) == [pipe]


@pytest.mark.parametrize("step", range(4))
@pytest.mark.parametrize("seal", ["seal.json", "seal.npy"])
def test_a_death_between_two_renames_leaves_a_mark(tmp_path, step, seal, monkeypatch) -> None:
    """Two runs' files side by side never have the seal of one of them."""
    names = ("a.csv", "b.csv", seal)

    def write(text: str) -> None:
        with Outputs() as outputs:
            for name in names:
                outputs.write_text(json.dumps(text), tmp_path / name)
            outputs.drop(tmp_path / "old.csv")

    (tmp_path / "old.csv").write_text("old")
    write("A")
    assert {p.name for p in tmp_path.iterdir()} == {*names}
    replace, steps = Path.replace, iter(range(10))

    def die(self: Path, target: Path) -> Path:
        if next(steps) == step:
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", die)
    if step < 3 or seal == "seal.json":
        with pytest.raises(KeyboardInterrupt):
            write("B")
    found = [json.loads((tmp_path / name).read_text()) for name in names[:2]]
    if seal == "seal.npy":
        assert (tmp_path / seal).exists() is (step == 3)
    elif step == 0:
        assert [*found, read_json(tmp_path / seal)] == ["A", "A", "A"]
    else:
        assert found == {1: ["A", "A"], 2: ["B", "A"], 3: ["B", "B"]}[step]
        with pytest.raises(InputError, match=r"seal\.json: unfinished: .* two runs; write them again"):
            read_json(tmp_path / seal)


def test_a_full_disk_leaves_nothing_half_written_and_no_key_is_overwritten(tmp_path, monkeypatch) -> None:
    write_secret(b"key", tmp_path / "k")
    assert stat.S_IMODE((tmp_path / "k").stat().st_mode) == 0o600
    with pytest.raises(OutputError, match="k: exists; a key is not overwritten"):
        write_secret(b"other", tmp_path / "k")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    for write in (lambda: write_secret(b"key", tmp_path / "half"), lambda: write_text("x", tmp_path / "a")):
        with pytest.raises(OutputError, match="cannot be written: No space left"):
            write()
    assert [p.name for p in tmp_path.iterdir()] == ["k"]


@pytest.mark.parametrize("text", ["=HYPERLINK(1)", "+1", "-1+2", "@SUM(A1)", "\t=1", "\r=1", "\uff1d1"])
def test_a_spreadsheet_finds_no_formula(text: str) -> None:
    assert escape_formula(text) == f"'{text}"
    for harmless in ("night.raw", "", "a=b", "1.5"):
        assert escape_formula(harmless) == harmless
    out = io.StringIO()
    csv.writer(out).writerow([escape_formula(text)])
    assert not re.match(r'"?\s*[=+\-@]', out.getvalue())


def test_a_csv_file_is_read_by_line(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_bytes(b"\xef\xbb\xbft_s,name\r\n1,a\r\n\r\n2,\r\n")
    assert read_csv(file) == (
        ("t_s", "name"),
        [(2, {"t_s": "1", "name": "a"}), (4, {"t_s": "2", "name": ""})],
    )
    file.write_bytes(b"")
    assert read_csv(file) == ((), [])


NEEDED = "t_us", "height_m"
OPTIONAL = "gravity_sigma_deg", "rate_right_deg_s", "rate_down_deg_s", "rate_up_deg_s"


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ((*NEEDED, "gravity_sigma"), "column 'gravity_sigma': expected gravity_sigma_deg"),
        ((*NEEDED, "sigma_gravity_deg"), "column '.*': expected gravity_sigma_deg"),
        ((*NEEDED, "gravty_sigma_deg"), "column '.*': expected gravity_sigma_deg"),
        ((*NEEDED, "rate_x_deg_s"), "column '.*': expected rate_right_deg_s"),
        ((*NEEDED, "rate_right_deg_s", "rate_down_rad_s", "rate_up_deg_s"), "expected rate_down_deg_s"),
        ((*NEEDED, *OPTIONAL[1:]), None),
        ((*NEEDED, *OPTIONAL, "rate_x_deg_s", "gravity_sigma_rad"), None),
        ((*NEEDED, "temperature", "weight_m", "note", "", "", "right"), None),
        (("t_us", "height"), "column 'height': expected height_m"),
        (("t_us",), r"no column height_m \(columns: t_us, height_m, gravity_sigma_deg"),
    ],
)
def test_a_column_that_is_not_as_it_is_called_is_reported(
    columns: tuple[str, ...], message: str | None
) -> None:
    if message is None:
        check_columns("a.csv", columns, NEEDED, OPTIONAL)
        return
    with pytest.raises(ConfigError, match=rf"^a\.csv: line 1: .*{message}"):
        check_columns("a.csv", columns, NEEDED, OPTIONAL)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs /dev/zero")
@pytest.mark.parametrize("read", [read_json, read_toml])
def test_a_file_without_end_is_not_read_whole(read: Callable[[str], Any]) -> None:
    with pytest.raises((InputError, ConfigError), match=r"^/dev/zero: cannot be read: larger than 256 MiB$"):
        read("/dev/zero")
