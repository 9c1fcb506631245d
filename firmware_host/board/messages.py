"""Messages that a board sends: once, again and again, or anew every so often."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from time import gmtime, strftime, time as clock_s
from typing import TYPE_CHECKING, Any

from evlcp_sdk.air.blocks import Message
from evlcp_sdk.air.kinds import Countdown
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.compose import encode_messages, iterate_packets, make_messages
from evlcp_sdk.scene.sites import BarSite, load_sites

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.link.resolve import Link
    from firmware_host.board.stream import Stream


@dataclass(frozen=True)
class Content:
    """What is to be sent, some of which changes with the time.

    Attributes:
        fixed: What does not: arguments of `make_messages`.
        text: A text; where it is sent anew, `{time}`, `{left}` and `{n}` in it are filled in.
        time: The time is sent.
        ends_s: When what a signal shows ends, seconds since 1970.
        signals: What it shows, and what then.
        sequence: Number of the first.
    """

    fixed: Mapping[str, Any]
    text: str | None
    time: bool
    ends_s: float | None
    signals: tuple[str, str]
    sequence: int

    def at(self, link: Link, at_s: float, number: int | None = None) -> list[Message]:
        """The messages of a time, seconds since 1970; of those sent anew, the ones of this number.

        Raises:
            ConfigError: They do not fit.
        """
        left_s = 0.0 if self.ends_s is None else max(0.0, self.ends_s - at_s)
        other: dict[str, Any] = {"time": at_s} if self.time else {}
        if self.ends_s is not None:
            other["countdown"] = Countdown(*self.signals, left_s)
        text = self.text
        if text is not None and number is not None:
            text = text.replace("{time}", strftime("%H:%M:%S", gmtime(at_s))).replace("{n}", str(number))
            text = text.replace("{left}", f"{left_s:.0f}")
        sequence = self.sequence + (number or 0)
        return make_messages(link, **self.fixed, text=text, other=other, sequence=sequence)


def site_that_sends(path: Path, transmitter_id: int | None, by: str) -> BarSite:
    """The bar of a file of sites that sends: of an id, or the only one; `by` is how a person chooses one.

    Raises:
        ConfigError: The file is wrong, or it is not clear which bar is meant.
    """
    sites = load_sites(path)
    ids = ", ".join(str(s.transmitter_id) for s in sites)
    if transmitter_id is None and len(sites) > 1:
        raise ConfigError(f"{path}: {len(sites)} bars: choose one with {by}, of {ids}")
    chosen = [s for s in sites if transmitter_id in (None, s.transmitter_id)]
    if not chosen:
        raise ConfigError(f"{path}: no bar has transmitter_id {transmitter_id}, but {ids}")
    return chosen[0]


def packet_s(link: Link) -> float:
    """How long a packet is on air, s."""
    return link.packet.packet_chips / link.air.chip_rate_hz


def check_interval(content: Content, link: Link, repeat: int, every_s: float) -> None:
    """See that what is sent anew every so often takes no longer on air.

    Raises:
        ConfigError: It does.
    """
    many = len(encode_messages(content.at(link, clock_s(), 0), link.block_coder(), repeat))
    takes_s = many * packet_s(link)
    if takes_s > every_s:
        raise ConfigError(
            f"--every {every_s:g}: what is to be sent takes {takes_s:.4g} s on air,"
            f" {many} packets of {1e3 * packet_s(link):.4g} ms;"
            f" give --every {ceil(takes_s)} or more, or send less"
        )


def send_anew(
    stream: Stream,
    content: Content,
    link: Link,
    repeat: int,
    every_s: float,
    count: int | None,
    stopped: Callable[[], bool],
) -> None:
    """Send content anew every so often, until nothing is left of a countdown, or so many times.

    Each packet goes out `repeat` times in a row; `stopped` ends it.
    """
    coder = link.block_coder()

    def next_one(number: int) -> Iterator[NDArray[np.int64]] | None:
        at_s = clock_s() + stream.delay_s
        over = content.ends_s is not None and number and at_s > content.ends_s + every_s
        if over or (count is not None and number >= count):
            return None
        return iterate_packets(content.at(link, at_s, number), coder, repeat)

    stream.play(next_one, every_s, stopped)
