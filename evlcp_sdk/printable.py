"""External text, made safe for a terminal: it moves no cursor and sets no title; this imports nothing."""

_CONTROLS = {
    **{n: f"\\x{n:02x}" for n in (*range(0x20), *range(0x7F, 0xA0)) if chr(n) not in "\t\n"},
    # Marks that turn the direction of a text, and so disguise it.
    **{n: f"\\u{n:04x}" for n in (0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))},
}


def escape_controls(text: str) -> str:
    r"""Replace control characters, but tabs and line feeds, by escapes.

    So is a lone surrogate, which stands for a byte of a file's name that is no text.

    >>> print(escape_controls("\x1b]0;mine\x07.raw"))
    \x1b]0;mine\x07.raw
    """
    return text.translate(_CONTROLS).encode("utf-8", "backslashreplace").decode("utf-8")
