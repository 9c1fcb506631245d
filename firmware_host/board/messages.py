"""Messages that a board sends: once, repeatedly, or updated periodically."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from time import gmtime, strftime, time as clock_s
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.blocks import Message
from evlcp_sdk.air.kinds import Countdown
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.compose import encode_messages, iterate_packets, make_messages
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.scene.sites import BarSite, load_sites
from firmware_host.board.stream import Stream


@dataclass(frozen=True)
class Content:
    """The content of messages, some of which changes with time.

    Attributes:
        fixed: The constant part: arguments of `make_messages`.
        text: A text; sent periodically, with `{time}`, `{n}` and, for a countdown, `{left}` filled in.
        time: Whether the time is sent.
        ends_s: End of a countdown, seconds since 1970.
        signals: What a traffic light shows before and after it.
        sequence: Number of the first message.
    """

    fixed: Mapping[str, Any]
    text: str | None
    time: bool
    ends_s: float | None
    signals: tuple[str, str]
    sequence: int

    def messages_at(self, link: Link, at_s: float, number: int | None = None) -> list[Message]:
        """The messages at a time, seconds since 1970, with a number if they are sent periodically.

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
            text = text if self.ends_s is None else text.replace("{left}", f"{left_s:.0f}")
        sequence = self.sequence + (number or 0)
        return make_messages(link, **self.fixed, text=text, other=other, sequence=sequence)

    def unfilled_fields(self, periodic: bool) -> list[str]:
        """What looks like a field of the text, and is sent as it stands."""
        filled = {"{time}", "{n}"} if self.ends_s is None else {"{time}", "{n}", "{left}"}
        return [one for one in re.findall(r"{\w+}", self.text or "") if not (periodic and one in filled)]


def choose_site(path: Path, transmitter_id: int | None, option: str) -> BarSite:
    """The bar with an id in a file of sites, or the only one; `option` is named for the choice in errors.

    Raises:
        ConfigError: The file is wrong, or the bar is not determined.
    """
    sites = load_sites(path)
    ids = ", ".join(str(s.transmitter_id) for s in sites)
    if transmitter_id is None and len(sites) > 1:
        raise ConfigError(f"{path}: {len(sites)} bars: choose one with {option}, of {ids}")
    chosen = [s for s in sites if transmitter_id in (None, s.transmitter_id)]
    if not chosen:
        raise ConfigError(f"{path}: no bar has transmitter_id {transmitter_id}, but {ids}")
    return chosen[0]


def check_interval(content: Content, link: Link, repeat: int, every_s: float) -> None:
    """Raise ConfigError if messages take longer on air than the period in which they are sent."""
    count = len(encode_messages(content.messages_at(link, clock_s(), 0), link.block_coder(), repeat))
    takes_s = count * (link.packet.packet_us / 1e6)
    if takes_s > every_s:
        raise ConfigError(
            f"--every {every_s:g}: what is to be sent takes {takes_s:.4g} s on air,"
            f" {count} packets of {link.packet.packet_us / 1e3:.4g} ms;"
            f" give --every {ceil(takes_s)} or more, or send less"
        )


def send_periodically(
    stream: Stream,
    content: Content,
    link: Link,
    repeat: int,
    every_s: float,
    count: int | None,
    stopped: Callable[[], bool],
) -> None:
    """Send updated content every `every_s`, `count` times or until its countdown ends.

    Each packet is sent `repeat` times in a row; `stopped` is asked whether to end early.
    """
    coder = link.block_coder()

    def make_packets(number: int) -> Iterator[NDArray[np.int64]] | None:
        at_s = clock_s() + stream.delay_s
        is_over = content.ends_s is not None and number and at_s > content.ends_s + every_s
        if is_over or (count is not None and number >= count):
            return None
        return iterate_packets(content.messages_at(link, at_s, number), coder, repeat)

    stream.play(make_packets, every_s, stopped)
