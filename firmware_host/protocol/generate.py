"""Writes the C headers and the Python module that `protocol.toml` and the codebook define.

`python -m firmware_host.protocol.generate` writes them; `--check` only says which are stale and ends with 1.
"""

import argparse
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from evlcp_sdk.link.resolve import resolve

HERE = Path(__file__).parents[1]

_SIZES = {"u8": 1, "u16": 2, "u32": 4, "i16": 2}
_CODES = {"u8": "B", "u16": "H", "u32": "I", "i16": "h"}


@dataclass(frozen=True)
class Field:
    """One field of a payload.

    Attributes:
        name: Its name.
        base: Type of an element: u8, u16, u32, i16 or bytes.
        count: Elements; 0 for the rest of the payload.
        doc: Meaning.
        since: Minor version that brought it.

    >>> Field.parse({"name": "pilots", "type": "u16[16]", "doc": "Pilot words."}).size
    32
    """

    name: str
    base: str
    count: int
    doc: str
    since: int = 0

    @classmethod
    def parse(cls, table: dict[str, Any]) -> "Field":
        """Read one field of the definition."""
        base, bracket, count = table["type"].partition("[")
        n = int(count[:-1]) if bracket else (0 if base == "bytes" else 1)
        return cls(table["name"], base, n, table["doc"], table.get("since", 0))

    @property
    def size(self) -> int:
        """Bytes; 0 for the rest of the payload."""
        return _SIZES.get(self.base, 1) * self.count

    @property
    def bits(self) -> int:
        """Of an element."""
        return 8 * _SIZES[self.base]

    @property
    def c_type(self) -> str:
        """C type of an element."""
        return (
            f"{'int' if self.base[0] == 'i' else 'uint'}{self.bits}_t" if self.base in _SIZES else "uint8_t"
        )

    @property
    def python_type(self) -> str:
        """Annotation, with its `struct` code."""
        if self.base == "bytes":
            return f'Annotated[bytes, "{self.count}s"]' if self.count else "Rest"
        if self.count == 1:
            return self.base.upper()
        return f'Annotated[tuple[int, ...], "{self.count}{_CODES[self.base]}"]'

    @property
    def python_default(self) -> str:
        """What stands for it where it is not known; empty if it always is."""
        if not self.since:
            return ""
        absent = "0" if self.count == 1 else f"(0,) * {self.count}"
        if self.base == "bytes":
            absent = f"bytes({self.count})"
        return f' = field(default={absent}, metadata={{"since": {self.since}}})'


@dataclass(frozen=True)
class Exchange:
    """A request and its reply.

    Attributes:
        name: Its name.
        type: Its number.
        kind: session, query, data or control.
        doc: Meaning.
        request: Fields of the request.
        reply: Fields of the reply.
        since: Minor version that brought it.
    """

    name: str
    type: int
    kind: str
    doc: str
    request: list[Field]
    reply: list[Field]
    since: int = 0

    @classmethod
    def parse(cls, table: dict[str, Any]) -> "Exchange":
        """Read one message of the definition."""
        parts = {part: [Field.parse(f) for f in table[part]] for part in ("request", "reply")}
        for fields in parts.values():
            if [f.since for f in fields] != sorted(f.since for f in fields):
                raise ValueError(f"message {table['name']}: a field with `since` stands before one without")
            if any(f.since and not f.size for f in fields):
                raise ValueError(f"message {table['name']}: a field of any length cannot come later")
        return cls(**table | parts)

    @property
    def request_bytes(self) -> int:
        """Of the request, data left out."""
        return sum(f.size for f in self.request)

    @property
    def takes_more(self) -> bool:
        """Whether a request may be longer; the board leaves alone what a later host adds to HELLO."""
        return self.kind == "session" or any(not f.size for f in self.request)


_CLASSES = {"fault": "BoardFault"}
"""Classes whose name is not that of their definition, which the SDK has for something else."""

_NUMBERS = {
    "protocol": ("header_bytes", "crc_bytes", "max_payload", "window", "default_baud"),
    "geometry": ("clusters", "leds", "row_bytes"),
}
"""Numbers of the definition that are constants of the Python module."""


def _camel(name: str) -> str:
    return _CLASSES.get(name) or "".join(part.capitalize() for part in name.split("_"))


def _reply_class(message: Exchange) -> str:
    return f"{_camel(message.name)}Reply" if message.reply else "EmptyReply"


def _with_offsets(fields: Sequence[Field]) -> list[tuple[Field, int]]:
    return list(zip(fields, accumulate((f.size for f in fields), initial=0), strict=False))


def _fields_table(message: Exchange, major: int) -> str:
    rows = []
    for kind, fields in (("request", message.request), ("reply", message.reply)):
        for f in fields:
            many = f"[{f.count}]" if f.count > 1 else "" if f.size else " to the end"
            later = f" Since {major}.{f.since}." if f.since else ""
            rows.append(("" if f is not fields[0] else kind, f.name, f"{f.base}{many}", f"{f.doc}{later}"))
    return _columns(rows)


def _numbers_table(enum: dict[str, Any]) -> str:
    return _columns([(str(e["value"]), k.upper(), e["doc"]) for k, e in enum.items() if k != "doc"])


_TEMPLATES = Environment(
    loader=PackageLoader("firmware_host.protocol"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_TEMPLATES.filters |= {
    "camel": _camel,
    "reply_class": _reply_class,
    "with_offsets": _with_offsets,
    "fields_table": _fields_table,
    "numbers_table": _numbers_table,
}


def render(template: str, definition: dict[str, Any]) -> str:
    """A generated file: `requests.py`, `profiles.py`, `protocol.h`, `profiles.h` or `protocol.md`.

    Raises:
        ValueError: The definition contradicts itself.
    """
    messages = [Exchange.parse(table) for table in definition["message"]]
    numbers = [(key.upper(), definition[part][key]) for part, keys in _NUMBERS.items() for key in keys]
    return _TEMPLATES.get_template(f"{template}.j2").render(
        definition,
        messages=messages,
        numbers=numbers,
        stored=[(t["name"], t["doc"], [Field.parse(f) for f in t["fields"]]) for t in definition["stored"]],
        digests={
            # those that the firmware is built with: of the default link with another profile
            profile: resolve({"modulation": {"id": profile}}).codebook.digest
            for profile in definition["enums"]["profile"]
            if profile not in ("doc", "custom")
        },
    )


def _columns(rows: Sequence[tuple[str, ...]]) -> str:
    """A fenced block of left-aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(["```text", *lines, "```"])


_MARK = "<!-- What follows is generated from protocol.toml by firmware_host.protocol.generate. -->\n"


def generated_files() -> dict[Path, str]:
    """Every generated file and what it should hold."""
    definition = tomllib.loads((HERE / "protocol" / "protocol.toml").read_text())
    headers, modules = HERE / "firmware" / "generated", HERE / "protocol" / "generated"
    places = {"requests.py": modules, "profiles.py": modules, "protocol.h": headers, "profiles.h": headers}
    files = {folder / name: render(name, definition) for name, folder in places.items()}
    files[headers / "codebook.h"] = resolve({}).codebook.to_c()
    page = HERE.parent / "docs" / "protocol.md"
    if page.exists():  # in a checkout; an installed package has no docs
        head = page.read_text().partition(_MARK)[0]
        files[page] = head + _MARK + render("protocol.md", definition)
    return files


def main(arguments: list[str] | None = None) -> int:
    """Write the generated files, or with `--check` name the stale ones and return 1."""
    parser = argparse.ArgumentParser(prog="python -m firmware_host.protocol.generate", description=__doc__)
    parser.add_argument("--check", action="store_true", help="only say which files are stale")
    check = parser.parse_args(arguments).check
    stale = [p for p, text in generated_files().items() if not p.exists() or p.read_text() != text]
    for path in stale:
        if check:
            sys.stderr.write(f"{path.name} is stale: run python -m firmware_host.protocol.generate\n")
        else:
            path.write_text(generated_files()[path])
            sys.stdout.write(f"wrote {path.name}\n")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
