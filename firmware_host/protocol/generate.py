"""Generates C headers, Python modules and a page of the docs from `protocol.toml` and the codebook.

`python -m firmware_host.protocol.generate` writes them.
"""

import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from evlcp_sdk.link.resolve import resolve

HERE = Path(__file__).parents[1]

_BASES = {
    "u8": (1, "uint8_t"),
    "u16": (2, "uint16_t"),
    "u32": (4, "uint32_t"),
    "i16": (2, "int16_t"),
    "bytes": (1, "uint8_t"),
}
"""Element types: bytes, and C type."""

Table = dict[str, Any]


def _expand_field(table: Table) -> Table:
    """A field of a payload with its derived values for templates; the count of the payload's rest is 0."""
    base, _, number = table["type"].removesuffix("]").partition("[")
    size, c_type = _BASES[base]
    count = int(number) if number else int(base != "bytes")
    if number:
        python, absent = f'Annotated[bytes, "{size * count}s"]', f"bytes({size * count})"
    else:
        python, absent = base.upper() if count else "Rest", "0"
    since = table.get("since", 0)
    return table | {
        "base": base,
        "count": count,
        "since": since,
        "size": size * count,
        "c_type": c_type,
        "python_type": python,
        # its value if an earlier version lacks it
        "python_default": f' = field(default={absent}, metadata={{"since": {since}}})' if since else "",
    }


def _expand_message(table: Table) -> Table:
    parts = {part: [_expand_field(f) for f in table[part]] for part in ("request", "reply")}
    request = parts["request"]
    return {
        "since": 0,
        "needs": "",
        "dark": False,
        **table,
        **parts,
        "request_bytes": sum(f["size"] for f in request),
        # the board ignores fields that a later host adds to HELLO
        "takes_more": table["kind"] == "session" or not all(f["size"] for f in request),
    }


_CLASSES = {"fault": "BoardFault"}
"""Class names that differ from their definition, as the SDK uses that name for something else."""


def _to_camel_case(name: str) -> str:
    return _CLASSES.get(name) or "".join(part.capitalize() for part in name.split("_"))


def _reply_class(message: Table) -> str:
    return f"{_to_camel_case(message['name'])}Reply" if message["reply"] else "EmptyReply"


def _fields_table(message: Table, major: int) -> str:
    rows = []
    for kind in ("request", "reply"):
        for n, f in enumerate(message[kind]):
            type_ = f["type"] if f["size"] else "bytes to the end"
            later = f" Since {major}.{f['since']}." if f["since"] else ""
            rows.append(("" if n else kind, f["name"], type_, f["doc"] + later))
    return _align_columns(rows)


def _numbers_table(enum: Table) -> str:
    return _align_columns([(str(e["value"]), k.upper(), e["doc"]) for k, e in enum.items() if k != "doc"])


_TEMPLATES = Environment(
    loader=PackageLoader("firmware_host.protocol"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_TEMPLATES.filters |= {
    "camel": _to_camel_case,
    "reply_class": _reply_class,
    "fields_table": _fields_table,
    "numbers_table": _numbers_table,
}


def render_template(template: str, definition: Table) -> str:
    """A generated file: `requests.py`, `profiles.py`, `protocol.h`, `profiles.h` or `protocol.md`."""
    messages = [_expand_message(table) for table in definition["message"]]
    return _TEMPLATES.get_template(f"{template}.j2").render(
        definition,
        messages=messages,
        stored=[(t["name"], t["doc"], [_expand_field(f) for f in t["fields"]]) for t in definition["stored"]],
        digests={
            # the firmware is built with these: the default link's with each profile
            profile: resolve({"modulation": {"id": profile}}).codebook.digest
            for profile in definition["enums"]["profile"]
            if profile not in ("doc", "custom")
        },
    )


def _align_columns(rows: Sequence[tuple[str, ...]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(["```text", *lines, "```"])


_MARK = "<!-- What follows is generated from protocol.toml by firmware_host.protocol.generate. -->\n"


def render_files() -> dict[Path, str]:
    """Content of every generated file by its path."""
    definition = tomllib.loads((HERE / "protocol" / "protocol.toml").read_text())
    headers, modules = HERE / "firmware" / "generated", HERE / "protocol" / "generated"
    places = {"requests.py": modules, "profiles.py": modules, "protocol.h": headers, "profiles.h": headers}
    files = {folder / name: render_template(name, definition) for name, folder in places.items()}
    files[headers / "codebook.h"] = resolve({}).codebook.to_c()
    page = HERE.parent / "docs" / "protocol.md"
    if page.exists():  # in a checkout; an installed package has no docs
        head = page.read_text().partition(_MARK)[0]
        files[page] = head + _MARK + render_template("protocol.md", definition)
    return files


def main() -> None:
    """Write the generated files that are stale."""
    for path, text in render_files().items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
            sys.stdout.write(f"wrote {path.name}\n")


if __name__ == "__main__":
    main()
