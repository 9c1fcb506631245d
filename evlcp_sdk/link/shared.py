"""The differences of two links in what both ends must share."""

import numpy as np

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.formatting import format_value
from evlcp_sdk.link.blocks import packet_bits
from evlcp_sdk.link.resolve import Link

_TEST_MESSAGES = 4


def find_differences(sent: Link, received: Link, *, messages: bool = False) -> tuple[str, ...]:
    """One text for each difference in what both ends must share; empty if they fit.

    Chip rate, frames of a packet, pilots, codes and the layout of the clusters count; the camera, the
    decoding and all else that only one end needs may differ.

    Args:
        sent: The link of the transmitter.
        received: The link of the receiver.
        messages: Whether messages are sent, so that the error correction counts, too.

    >>> from evlcp_sdk.link.resolve import resolve
    >>> find_differences(resolve({"air": {"chip_rate_hz": 5000.0}}), resolve({}))
    ('air.chip_rate_hz: sent with 5000.0, received with 10000.0',)
    """
    found = _key_differences(sent, received, "air", "chip_rate_hz", "frames_per_packet", "pilot_every")
    if sent.codebook != received.codebook:
        found += _code_differences(sent, received)
    ours, theirs = sent.bar.cluster_centres_m(), received.bar.cluster_centres_m()
    if ours.shape != theirs.shape or not np.allclose(ours, theirs, rtol=1e-6, atol=1e-9):
        other_shape = _key_differences(sent, received, "bar", "shape")
        found += other_shape or _key_differences(sent, received, "bar", *sent.table["bar"])
    if messages and not _has_same_correction(sent, received):
        found += _role_differences(sent, received, "error-correction")
    return tuple(found)


def _code_differences(sent: Link, received: Link) -> list[str]:
    """Roles whose codes differ, but for the number of clusters, which the layout shows."""
    ours, theirs = sent.codebook, received.codebook
    if framing := _setting_differences(sent, received, "framing"):
        return framing
    both, found = min(ours.clusters, theirs.clusters), []
    if not (
        np.array_equal(ours.preamble, theirs.preamble)
        and np.array_equal(ours.pilots[:both], theirs.pilots[:both])
    ):
        found += _role_differences(sent, received, "pilots")
    if ours.profile != theirs.profile or not np.array_equal(ours.codewords, theirs.codewords):
        found += _role_differences(sent, received, "modulation")
    return found


def _has_same_correction(sent: Link, received: Link) -> bool:
    """Whether both ends encode messages alike; the decoding may differ."""
    try:
        ours, theirs = (
            link.algorithm("error-correction").compile(packet_bits(link.codebook, link.packet))
            for link in (sent, received)
        )
    except ConfigError:
        return False
    if (ours.message_bits, ours.coded_bits) != (theirs.message_bits, theirs.coded_bits):
        return False
    rng = np.random.default_rng(0)
    tried = (rng.integers(0, 2, ours.message_bits, np.uint8) for _ in range(_TEST_MESSAGES))
    return all(np.array_equal(ours.encode(bits), theirs.encode(bits)) for bits in tried)


def _role_differences(sent: Link, received: Link, role: str) -> list[str]:
    """The settings in which a role differs, or else its revision or codes."""
    if found := _setting_differences(sent, received, role):
        return found
    role = role if role in sent.table else "framing"
    name, a, b = sent.table[role]["id"], sent.revisions[role], received.revisions[role]
    which = f"revision {a}, received with revision {b}" if a != b else "other codes than those received with"
    return [f"{role}.id = {format_value(name)}: sent with {which}"]


def _setting_differences(sent: Link, received: Link, role: str) -> list[str]:
    """The difference in a role's algorithm, or else in its parameters."""
    if role not in sent.table or role not in received.table:
        return []
    other_id = _key_differences(sent, received, role, "id")
    return other_id or _key_differences(sent, received, role, *sent.table[role])


def _key_differences(sent: Link, received: Link, section: str, *keys: str) -> list[str]:
    values = ((key, sent.table[section].get(key), received.table[section].get(key)) for key in keys)
    return [
        f"{section}.{key}: sent with {format_value(a)}, received with {format_value(b)}"
        for key, a, b in values
        if a != b
    ]
