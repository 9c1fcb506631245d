"""Files read and written whole."""

from pathlib import Path

import pytest

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError
from evlcp_sdk.files import read_csv, read_json, whole_file, write_text
from evlcp_sdk.specs import parse_value, read_toml


def test_a_table_is_read(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("[bar]\nleds = 96\nname = 'ü'\n", encoding="utf-8")
    assert read_toml(file) == read_toml(str(file)) == {"bar": {"leds": 96, "name": "ü"}}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"a = \n", r"a\.toml: not TOML: Invalid value \(at line 1"),
        (b"a = '\xff'\n", r"a\.toml: at byte 5: not UTF-8 text"),
        (b"a = " + 2000 * b"[", r"a\.toml: not TOML: "),
    ],
)
def test_what_is_no_toml_is_one_line(content: bytes, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        read_toml(tmp_path / "a.toml")


def test_what_cannot_be_read_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"b\.toml: cannot be read: No such file"):
        read_toml(tmp_path / "b.toml")
    with pytest.raises(ConfigError, match=r"cannot be read: Is a directory"):
        read_toml(tmp_path)


@pytest.mark.parametrize(
    ("text", "value"),
    [("3", 3), (" 0.5 ", 0.5), ("true", True), ("[1, 'a']", [1, "a"]), ("wh8", "wh8"), (" a b ", "a b")],
)
def test_values(text: str, value: object) -> None:
    assert parse_value(text) == value


def break_off(path: Path) -> None:
    with whole_file(path) as part:
        part.write_text("half")
        raise KeyError


def test_an_earlier_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text("old", path)
    with pytest.raises(KeyError):
        break_off(path)
    assert path.read_text() == "old"
    with whole_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, *_args: object, **_kwargs: object) -> None:
        self.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(EvlcpError, match=r"a\.txt: cannot be written: No space left"):
        write_text("x", tmp_path / "a.txt")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(EvlcpError, match=r"a\.txt: cannot be written: No such file"):
        write_text("x", tmp_path / "none" / "a.txt")


def test_a_csv_file_is_read_by_line(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_bytes(b"\xef\xbb\xbft_s,name\r\n1,a\r\n\r\n2\r\n")
    assert read_csv(file) == (
        ("t_s", "name"),
        [(2, {"t_s": "1", "name": "a"}), (4, {"t_s": "2", "name": None})],
    )
    file.write_bytes(b"")
    assert read_csv(file) == ((), [])


@pytest.mark.parametrize("content", [b"a\n\xff\n", b'a,b\n"' + 140_000 * b"x" + b'",1\n'])
def test_what_is_no_csv_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.csv: not a CSV file: ") as caught:
        read_csv(tmp_path / "a.csv")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"b\.csv: cannot be read: No such file"):
        read_csv(tmp_path / "b.csv")


@pytest.mark.parametrize("content", [b"{", b'"\xff"', 200_000 * b"["])
def test_what_is_no_json_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json: not JSON: ") as caught:
        read_json(tmp_path / "a.json")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"b\.json: cannot be read: No such file"):
        read_json(tmp_path / "b.json")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs /dev/zero")
def test_a_file_without_end_is_not_read_whole() -> None:
    with pytest.raises(InputError, match=r"^/dev/zero: cannot be read: larger than 256 MiB$"):
        read_json("/dev/zero")
    with pytest.raises(ConfigError, match=r"^/dev/zero: cannot be read: larger than 256 MiB$"):
        read_toml("/dev/zero")
