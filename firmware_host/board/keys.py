"""Files of boards' keys: 32 hex digits, readable by their owner alone."""

import secrets
from pathlib import Path

from evlcp_sdk.errors import InputError
from evlcp_sdk.files import read_secret, write_secret
from firmware_host.protocol.generated.requests import KEY_BYTES
from firmware_host.protocol.seal import key_name


def make_board_key(path: Path) -> str:
    """Write a new key; return its name, 8 hex digits.

    Raises:
        OutputError: The file exists, or cannot be written.
    """
    key = secrets.token_bytes(KEY_BYTES)
    write_secret(key.hex().encode() + b"\n", path)
    return key_name(key).hex()


def read_board_key(path: Path) -> bytes:
    """The key of a file.

    Raises:
        InputError: The file cannot be read, is accessible to others than its owner, or holds no key.
    """
    text = read_secret(path, 1024)
    try:
        key = bytes.fromhex(text.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES or not any(key):
        raise InputError(f"{path}: expected {2 * KEY_BYTES} hex digits, as 'evlcp board keygen' makes them")
    return key
