"""Kernels loaded before anything is live."""

from collections.abc import Sequence

from evlcp_sdk.files import shipped
from evlcp_sdk.io.raw import RawSource
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.pictures import PictureSlot
from evlcp_sdk.rx.receiver import Receiver

__all__ = ["warm_up"]

_WARM_US = 30_000
"""Of the recording that comes with the SDK: three packets, of which two are whole."""


def warm_up(links: Sequence[Link]) -> None:
    """Load what receiving needs, by receiving a piece of the recording that comes with the SDK."""
    receiver, pictures, camera = Receiver(links), PictureSlot(), links[0].camera
    with RawSource(shipped("recordings", "night-50m-30kmh-cut.raw")) as source:
        first_us = None
        for events in source.chunks(1 << 14):
            first_us = int(events.t_us[0]) if first_us is None else first_us
            pictures.ask()
            pictures.add(events, camera.width, camera.height, receiver.regions)
            if pictures.newest is not None:
                pictures.newest.image().png()
            receiver.feed(events)
            if int(events.t_us[0]) > first_us + _WARM_US:
                break
    receiver.close()
