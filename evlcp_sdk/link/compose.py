"""Messages as the packets that a transmitter plays."""

import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Kind, Message, split_message
from evlcp_sdk.air.kinds import find_kind
from evlcp_sdk.air.signing import read_key, sign
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.scene.sites import BarSite


def compose(
    link: Link | Path | str | None = None,
    *,
    text: str | None = None,
    data: bytes | None = None,
    beacon: Beacon | BarSite | None = None,
    user: bytes = b"",
    key: Path | str | None = None,
    other: Mapping[str, Any] | None = None,
    transmitter_id: int | None = None,
    sequence: int | None = None,
    repeat: int = 1,
) -> NDArray[np.int64]:
    """The symbols of packets with messages, int64 (packets, frames, clusters).

    Several messages follow one another: beacon, its signature, text, data, others.

    Args:
        link: The configuration, or a `link.toml`; None for all defaults.
        text: A text.
        data: Bytes.
        beacon: A beacon, or the site of the bar that sends it.
        user: The user's own bytes in a site's beacon.
        key: File of the private key that signs the beacon (needs the extra `sign`).
        other: Values of messages of other installed kinds, by the kind's name.
        transmitter_id: The sender; None for the site's id, or 0.
        sequence: Number of the messages; None for the seconds since 1970, so that it rises.
        repeat: Times in a row that each packet is sent.

    Raises:
        ConfigError: Nothing to send, a key or the user's bytes without a beacon, a kind that is not
            installed, a message that is too long or a number out of range, packets of the link that are too
            short for messages, or the extra is not installed.
        InputError: The key cannot be read.

    >>> compose(text="Tempo 30", transmitter_id=7).shape
    (1, 10, 16)
    """
    link = link if isinstance(link, Link) else load_link(link)
    if repeat < 1:
        raise ConfigError(f"repeat = {repeat}, expected 1 or more")
    messages = make_messages(
        link,
        text=text,
        data=data,
        beacon=beacon,
        user=user,
        key=key,
        other=other,
        transmitter_id=transmitter_id,
        sequence=sequence,
    )
    return encode_messages(messages, link.block_coder(), repeat)


def make_messages(
    link: Link,
    *,
    text: str | None = None,
    data: bytes | None = None,
    beacon: Beacon | BarSite | None = None,
    user: bytes = b"",
    key: Path | str | None = None,
    other: Mapping[str, Any] | None = None,
    transmitter_id: int | None = None,
    sequence: int | None = None,
) -> list[Message]:
    """The messages that `compose` encodes; arguments and errors as there."""
    if (key is not None and beacon is None) or (user and not isinstance(beacon, BarSite)):
        raise ConfigError("key signs a beacon, and user goes into that of a site: give one, too")
    if transmitter_id is None:
        transmitter_id = beacon.transmitter_id if isinstance(beacon, BarSite) else 0
    number = int(time.time()) if sequence is None else sequence
    messages: list[Message] = []
    if beacon is not None:
        content = beacon_of_site(beacon, user) if isinstance(beacon, BarSite) else beacon
        messages.append(Message(Kind.BEACON, transmitter_id, number, content.pack()))
        if key is not None:
            messages.append(sign(messages[0], link.block_coder().digest, read_key(Path(key))))
    if text is not None:
        messages.append(Message(Kind.TEXT, transmitter_id, number, encode_utf8(text, "text")))
    if data is not None:
        messages.append(Message(Kind.DATA, transmitter_id, number, bytes(data)))
    for name, value in (other or {}).items():
        kind = find_kind(name, link.kinds)
        messages.append(Message(kind.number, transmitter_id, number, kind.pack(value)))
    if not messages:
        raise ConfigError("nothing to send: give a text, data or a beacon")
    return messages


def encode_utf8(text: str, name: str) -> bytes:
    """The bytes of a text; a shell's bytes that are not UTF-8 arrive as lone surrogates.

    Raises:
        ConfigError: There are such characters.
    """
    try:
        return text.encode()
    except UnicodeEncodeError as fault:
        raise ConfigError(f"{name}: character {fault.start + 1} is not UTF-8; send bytes as data") from fault


def encode_messages(messages: Iterable[Message], coder: BlockCoder, repeat: int = 1) -> NDArray[np.int64]:
    """Symbols of the packets with messages, each sent `repeat` times, int64 (packets, frames, clusters)."""
    return np.stack(list(iterate_packets(messages, coder, repeat)))


def iterate_packets(
    messages: Iterable[Message], coder: BlockCoder, repeat: int = 1
) -> Iterator[NDArray[np.int64]]:
    """Symbols of the same packets one by one, int64 (frames, clusters), each encoded on demand."""
    blocks = [block for one in messages for block in split_message(one, coder.digest, coder.block_bytes)]
    packets = (coder.encode_symbols(block.pack(coder.block_bytes)) for block in blocks)
    return (packet for packet in packets for _ in range(repeat))


def beacon_of_site(site: BarSite, user: bytes = b"") -> Beacon:
    """The beacon of a bar at a site, with the user's own bytes."""
    place = site.latitude_deg, site.longitude_deg, site.height_m
    return Beacon(*place, site.heading_deg, site.tilt_deg, site.length_m, user)
