"""Loads kernels before a live run starts."""

from collections.abc import Sequence
from itertools import islice
from typing import Final

from evlcp_sdk.files import find_shipped_file
from evlcp_sdk.io.raw import RawSource
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.pictures import PictureSlot
from evlcp_sdk.place.error_model import chi_square
from evlcp_sdk.results.picture import encode_png
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.workers import has_bar_frames, load_decoder_kernels

_PIECES: Final = 19
"""Of the recording that comes with the SDK, 30 ms: three packets, of which two are whole."""


def load_kernels(links: Sequence[Link], *, positions: bool = False) -> None:
    """Load a receiver's kernels by frames of drawn bars and a piece of the recording that comes with the SDK.

    Of `positions`, load SciPy's functions: they have no kernels.
    """
    for link in filter(has_bar_frames, links):
        load_decoder_kernels(link)
    if positions:
        chi_square(0.5, 1)
    receiver, pictures, camera = Receiver(links), PictureSlot(), links[0].camera
    with RawSource(find_shipped_file("recordings", "night-50m-30kmh-cut.raw")) as source:
        for events in islice(source.chunks(1 << 14), _PIECES):
            pictures.request()
            pictures.add(events, camera.width, camera.height, receiver.regions)
            if pictures.newest is not None:
                encode_png(pictures.newest.paint())
            receiver.feed(events)
    receiver.close()
