"""Writes the C headers and the Python module that `protocol.toml` and the codebook define.

`python -m firmware_host.protocol.generate` writes them; `--check` only says which are stale and ends with 1.
"""

import argparse
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.link.resolve import resolve

__all__ = ["Field", "codebook_of", "generated_files", "main"]

HERE = Path(__file__).parents[1]

_SIZES = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i16": 2}
_CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "i16": "h"}
_C_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "u64": "uint64_t", "i16": "int16_t"}


@dataclass(frozen=True)
class Field:
    """One field of a payload.

    Attributes:
        name: Its name.
        base: Type of an element: u8, u16, u32, u64, i16 or bytes.
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
        if base not in _SIZES and base != "bytes":
            raise ValueError(f"field {table['name']}: type {table['type']} is unknown")
        n = int(count[:-1]) if bracket else (0 if base == "bytes" else 1)
        return cls(table["name"], base, n, table["doc"], table.get("since", 0))

    @property
    def size(self) -> int:
        """Bytes; 0 for the rest of the payload."""
        return _SIZES.get(self.base, 1) * self.count

    @property
    def layout(self) -> str:
        """Its code in `WireMessage.LAYOUT`."""
        if self.base == "bytes":
            return f"{self.count}s" if self.count else "*"
        return f"{self.count if self.count > 1 else ''}{_CODES[self.base]}"

    @property
    def python_type(self) -> str:
        """Annotation."""
        if self.base == "bytes":
            return "bytes"
        return "int" if self.count == 1 else "tuple[int, ...]"

    @property
    def python_default(self) -> str:
        """What stands for it where it is not known; empty if it always is."""
        if not self.since:
            return ""
        if self.base == "bytes":
            return f" = bytes({self.count})"
        return " = 0" if self.count == 1 else f" = (0,) * {self.count}"


def profiles_of(definition: dict[str, Any]) -> list[str]:
    """The profiles that the firmware is built with: those of the definition but `custom`, by number."""
    return [name for name in definition["enums"]["profile"] if name not in ("doc", "custom")]


def codebook_of(profile: str) -> Codebook:
    """The codebook of the default link with another profile.

    Raises:
        UnknownAlgorithmError: No modulation has that name.
    """
    return resolve({"modulation": {"id": profile}}).codebook


def _messages(definition: dict[str, Any]) -> Iterator[tuple[dict[str, Any], list[Field], list[Field]]]:
    for message in definition["message"]:
        request = [Field.parse(f) for f in message["request"]]
        reply = [Field.parse(f) for f in message["reply"]]
        for fields in (request, reply):
            if [f.since for f in fields] != sorted(f.since for f in fields):
                raise ValueError(f"message {message['name']}: a field with `since` stands before one without")
            if any(f.since and not f.size for f in fields):
                raise ValueError(f"message {message['name']}: a field of any length cannot come later")
        yield message, request, reply


_CLASSES = {"fault": "BoardFault"}
"""Classes whose name is not that of their definition, which the SDK has for something else."""


def _camel(name: str) -> str:
    return _CLASSES.get(name) or "".join(part.capitalize() for part in name.split("_"))


def python_module(definition: dict[str, Any]) -> str:
    """The Python module of the messages."""
    protocol, geometry = definition["protocol"], definition["geometry"]
    names = ["HEADER_BYTES", "CRC_BYTES", "MAX_PAYLOAD", "WINDOW", "DEFAULT_BAUD", "MAJOR", "MINOR"]
    names += ["CLUSTERS", "LEDS", "ROW_BYTES", "REPLIES", "Type"]
    names += [name.upper() for name in definition["constants"]]
    out = [
        '"""Messages of the driver board; `python -m firmware_host.protocol.generate` writes this file."""',
        "",
        "from dataclasses import dataclass",
        "from enum import IntEnum, IntFlag",
        "from typing import ClassVar",
        "",
        "from firmware_host.protocol.wire import WireMessage",
        "",
        "@ALL@",
        "",
        f"MAJOR = {protocol['major']}",
        '"""Version of the protocol: of another major one no message is understood."""',
        f"MINOR = {protocol['minor']}",
        '"""Version of the protocol: what it has beyond the major version\'s first."""',
        f"HEADER_BYTES = {protocol['header_bytes']}",
        f"CRC_BYTES = {protocol['crc_bytes']}",
        f"MAX_PAYLOAD = {protocol['max_payload']}",
        f"WINDOW = {protocol['window']}",
        f"DEFAULT_BAUD = {protocol['default_baud']}",
        f"CLUSTERS = {geometry['clusters']}",
        f"LEDS = {geometry['leds']}",
        f"ROW_BYTES = {geometry['row_bytes']}",
    ]
    for name, entry in definition["constants"].items():
        out += [f"{name.upper()} = 0x{entry['value']:X}", f'"""{entry["doc"]}"""']
    out += ["", "", "class Type(IntEnum):", '    """Requests."""', ""]
    for message, _, _ in _messages(definition):
        out.append(f"    {message['name'].upper()} = 0x{message['type']:02X}")
    for name, table in definition["enums"].items():
        base = "IntFlag" if name in ("capability", "fault") else "IntEnum"
        out += ["", "", f"class {_camel(name)}({base}):", f'    """{table["doc"]}"""', ""]
        names.append(_camel(name))
        for key, entry in table.items():
            if key != "doc":
                out += [f"    {key.upper()} = {entry['value']}", f'    """{entry["doc"]}"""']
    for message, request, reply in _messages(definition):
        for kind, fields in (("Request", request), ("Reply", reply)):
            cls = f"{_camel(message['name'])}{kind}"
            names.append(cls)
            verb = (
                message["doc"]
                if kind == "Request"
                else f"What the board answers to {message['name'].upper()}."
            )
            out += ["", "", "@dataclass(frozen=True, slots=True)", f"class {cls}(WireMessage):"]
            if fields:
                out += [f'    """{verb}', "", "    Attributes:"]
                out += [f"        {f.name}: {f.doc}" for f in fields]
                out += ['    """', ""]
            else:
                out += [f'    """{verb}"""', ""]
            out.append(f"    TYPE: ClassVar[int] = 0x{message['type']:02X}")
            head, codes = "    LAYOUT: ClassVar[str] = ", f'"{" ".join(f.layout for f in fields)}"'
            short = len(head + codes) <= 110
            out += [head + codes] if short else [f"{head}(", f"        {codes}", "    )"]
            if message.get("since", 0):
                out.append(f"    SINCE: ClassVar[int] = {message['since']}")
            later = [f'"{f.name}": {f.since}' for f in fields if f.since]
            if later:
                head = "    FIELD_SINCE: ClassVar[dict[str, int]] = {"
                one = f"{head}{', '.join(later)}}}"
                out += [one] if len(one) <= 110 else [head, *(f"        {row}," for row in later), "    }"]
            if fields:
                out.append("")
            out += [f"    {f.name}: {f.python_type}{f.python_default}" for f in fields]
    out += ["", "", "REPLIES: dict[int, type[WireMessage]] = {"]
    out += [f"    0x{m['type']:02X}: {_camel(m['name'])}Reply," for m, _, _ in _messages(definition)]
    out += ["}", '"""The reply of each request type."""', ""]
    constants = sorted(n for n in names if n.isupper())
    classes = sorted(n for n in names if not n.isupper())
    listed = "__all__ = [\n" + "".join(f'    "{n}",\n' for n in constants + classes) + "]"
    return "\n".join(out).replace("@ALL@", listed)


def _c_put(field: Field, at: int) -> list[str]:
    if field.base == "bytes":
        return [f"    evlcp_copy(p + {at}, m->{field.name}, {field.count}u);"]
    size = _SIZES[field.base]
    if field.count > 1:
        return [
            f"    for (uint32_t i = 0; i < {field.count}u; i++)",
            f"        evlcp_put{8 * size}(p + {at} + {size}u * i, m->{field.name}[i]);",
        ]
    cast = f"(u{_C_TYPES[field.base]})" if field.base.startswith("i") else ""
    return [f"    evlcp_put{8 * size}(p + {at}, {cast}m->{field.name});"]


def _c_get(field: Field, at: int) -> list[str]:
    if field.base == "bytes":
        return [f"    evlcp_copy(m->{field.name}, p + {at}, {field.count}u);"]
    size = _SIZES[field.base]
    if field.count > 1:
        return [
            f"    for (uint32_t i = 0; i < {field.count}u; i++)",
            f"        m->{field.name}[i] = evlcp_get{8 * size}(p + {at} + {size}u * i);",
        ]
    cast = f"({_C_TYPES[field.base]})" if field.base.startswith("i") else ""
    return [f"    m->{field.name} = {cast}evlcp_get{8 * size}(p + {at});"]


_C_HELPERS = """
static inline void evlcp_copy(uint8_t *to, const uint8_t *from, uint32_t n)
{
    for (uint32_t i = 0; i < n; i++)
        to[i] = from[i];
}

static inline void evlcp_put8(uint8_t *p, uint8_t v)
{
    p[0] = v;
}

static inline void evlcp_put16(uint8_t *p, uint16_t v)
{
    p[0] = (uint8_t)v;
    p[1] = (uint8_t)(v >> 8);
}

static inline void evlcp_put32(uint8_t *p, uint32_t v)
{
    evlcp_put16(p, (uint16_t)v);
    evlcp_put16(p + 2, (uint16_t)(v >> 16));
}

static inline uint8_t evlcp_get8(const uint8_t *p)
{
    return p[0];
}

static inline uint16_t evlcp_get16(const uint8_t *p)
{
    return (uint16_t)(p[0] | (uint16_t)(p[1] << 8));
}

static inline uint32_t evlcp_get32(const uint8_t *p)
{
    return evlcp_get16(p) | (uint32_t)evlcp_get16(p + 2) << 16;
}
"""


def c_header(definition: dict[str, Any]) -> str:
    """The C header of the messages: numbers, and for each message a struct, its size, put and get."""
    protocol, geometry = definition["protocol"], definition["geometry"]
    out = [
        "/* Messages of the driver board; generated from protocol.toml, do not edit. */",
        "#ifndef EVLCP_PROTOCOL_H",
        "#define EVLCP_PROTOCOL_H",
        "#include <stdint.h>",
        "",
        f"#define EVLCP_PROTOCOL_MAJOR {protocol['major']}u",
        f"#define EVLCP_PROTOCOL_MINOR {protocol['minor']}u",
        f"#define EVLCP_HEADER_BYTES {protocol['header_bytes']}u",
        f"#define EVLCP_CRC_BYTES {protocol['crc_bytes']}u",
        f"#define EVLCP_MAX_PAYLOAD {protocol['max_payload']}u",
        f"#define EVLCP_WINDOW {protocol['window']}u",
        f"#define EVLCP_BAUD {protocol['default_baud']}u",
        f"#define EVLCP_BOARD_CLUSTERS {geometry['clusters']}u",
        f"#define EVLCP_LEDS {geometry['leds']}u",
        f"#define EVLCP_ROW_BYTES {geometry['row_bytes']}u",
    ]
    for name, entry in definition["constants"].items():
        out.append(f"#define EVLCP_{name.upper()} 0x{entry['value']:x}u /* {entry['doc']} */")
    out += ["", "enum evlcp_type {"]
    out += [f"    EVLCP_TYPE_{m['name'].upper()} = 0x{m['type']:02x}," for m, _, _ in _messages(definition)]
    out.append("};")
    for name, table in definition["enums"].items():
        out += ["", f"/* {table['doc']} */", f"enum evlcp_{name} {{"]
        for key, entry in table.items():
            if key != "doc":
                out.append(f"    EVLCP_{name.upper()}_{key.upper()} = {entry['value']}, /* {entry['doc']} */")
        out.append("};")
    out.append(_C_HELPERS.rstrip())
    for message, request, reply in _messages(definition):
        for kind, fields in (("request", request), ("reply", reply)):
            name = f"evlcp_{message['name']}_{kind}"
            size = sum(f.size for f in fields)
            out += ["", f"#define {name.upper()}_BYTES {size}u"]
            fixed = [f for f in fields if f.size]
            if not fixed:
                continue
            out += [f"/* {message['doc']} */" if kind == "request" else f"/* Answer to {message['name']}. */"]
            out.append(f"struct {name} {{")
            for f in fixed:
                c_type = _C_TYPES.get(f.base, "uint8_t")
                many = f"[{f.count}]" if f.count > 1 or f.base == "bytes" else ""
                out.append(f"    {c_type} {f.name}{many}; /* {f.doc} */")
            out.append("};")
            for verb, step, signature in (
                ("put", _c_put, f"uint8_t *p, const struct {name} *m"),
                ("get", _c_get, f"const uint8_t *p, struct {name} *m"),
            ):
                out += ["", f"static inline void {name}_{verb}({signature})", "{"]
                at = 0
                for f in fixed:
                    out += step(f, at)
                    at += f.size
                out.append("}")
    sizes = {m["name"]: sum(f.size for f in request) for m, request, _ in _messages(definition)}
    out += [
        "",
        f"#define EVLCP_REQUEST_MOST {max(sizes.values())}u /* longest request, data left out */",
        "",
        "/* Requests: type, whether control, whether a query, whether any length may follow, and the length,",
        "   that of the first minor version and today's; a shorter one goes on with zeros. */",
        "#define EVLCP_SHAPES \\",
    ]
    rows = []
    for message, request, _ in _messages(definition):
        least = sum(f.size for f in request if not f.since)
        control, query = (str(message["kind"] == kind).lower() for kind in ("control", "query"))
        # what a later host adds to HELLO is for the board to leave alone
        more = "true" if message["kind"] == "session" or any(not f.size for f in request) else "false"
        rows.append(
            f"    {{0x{message['type']:02x}u, {control}, {query}, {more}, {least}u,"
            f" {sizes[message['name']]}u}}"
        )
    out += [", \\\n".join(rows), "", "#endif", ""]
    return "\n".join(out)


def profiles_header(profiles: Sequence[str]) -> str:
    """The C header of the codebook digests that the firmware knows."""
    out = [
        "/* Codebook digests of the built-in profiles; generated, do not edit. */",
        "#ifndef EVLCP_PROFILES_H",
        "#define EVLCP_PROFILES_H",
        "#include <stdint.h>",
        f"#define EVLCP_PROFILES {len(profiles)}u",
        f"static const uint8_t evlcp_profile_digests[{len(profiles)}][32] = {{",
    ]
    for profile in profiles:
        digest = bytes.fromhex(codebook_of(profile).digest)
        rows = [", ".join(f"0x{b:02x}u" for b in digest[i : i + 16]) for i in (0, 16)]
        out.append(f"    /* {profile} */\n    {{{rows[0]},\n     {rows[1]}}},")
    return "\n".join([*out, "};", "#endif", ""])


def profiles_module(profiles: Sequence[str]) -> str:
    """The Python module of the same digests."""
    rows = [f'    Profile.{p.upper()}: "{codebook_of(p).digest}",' for p in profiles]
    return "\n".join(
        [
            '"""Codebooks of the firmware; `python -m firmware_host.protocol.generate` writes this file."""',
            "",
            "from firmware_host.protocol.generated.requests import Profile",
            "",
            '__all__ = ["DIGESTS"]',
            "",
            "DIGESTS = {",
            *rows,
            "}",
            '"""Digest of each profile\'s codebook, 64 hex digits."""',
            "",
        ]
    )


_MARK = "<!-- What follows is generated from protocol.toml by firmware_host.protocol.generate. -->\n"


def markdown(definition: dict[str, Any]) -> str:
    """The messages and numbers as Markdown, their fields and values as columns."""
    out = ["", "## Messages"]
    for m, request, reply in _messages(definition):
        out += ["", f"### {m['name'].upper()}", "", f"0x{m['type']:02x}, {m['kind']}. {m['doc']}"]
        rows = []
        for kind, fields in (("request", request), ("reply", reply)):
            for f in fields:
                many = f"[{f.count}]" if f.count > 1 else ""
                rest = " to the end" if f.base == "bytes" and not f.count else ""
                later = f" Since {definition['protocol']['major']}.{f.since}." if f.since else ""
                first = "" if f is not fields[0] else kind
                rows.append((first, f.name, f"{f.base}{many}{rest}", f"{f.doc}{later}"))
        if rows:
            out += ["", *_columns(rows)]
    for name, table in definition["enums"].items():
        out += ["", f"## Numbers of {name}", "", table["doc"], ""]
        out += _columns([(str(e["value"]), k.upper(), e["doc"]) for k, e in table.items() if k != "doc"])
    return "\n".join([*out, ""])


def _columns(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """A fenced block of left-aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows)
    return ["```text", *lines, "```"]


def generated_files() -> dict[Path, str]:
    """Every generated file and what it should hold."""
    definition = tomllib.loads((HERE / "protocol" / "protocol.toml").read_text())
    generated = HERE / "firmware" / "generated"
    files = {
        HERE / "protocol" / "generated" / "requests.py": python_module(definition),
        HERE / "protocol" / "generated" / "profiles.py": profiles_module(profiles_of(definition)),
        generated / "protocol.h": c_header(definition),
        generated / "codebook.h": resolve({}).codebook.to_c(),
        generated / "profiles.h": profiles_header(profiles_of(definition)),
    }
    page = HERE.parent / "docs" / "protocol.md"
    if page.exists():  # in a checkout; an installed package has no docs
        head = page.read_text().partition(_MARK)[0]
        files[page] = head + _MARK + markdown(definition)
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
