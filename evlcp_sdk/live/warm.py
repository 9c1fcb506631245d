"""Loads kernels before a live run starts."""

from collections.abc import Sequence
from itertools import islice
from typing import Final

import numpy as np

from evlcp_sdk.files import find_shipped_file
from evlcp_sdk.io.raw import RawSource
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.pictures import PictureSlot
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.observations import BarView, project_bars
from evlcp_sdk.place.pose import solve_pose
from evlcp_sdk.results.picture import encode_png
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.workers import has_bar_frames, load_decoder_kernels
from evlcp_sdk.scene.attitude import Attitude

_PIECES: Final = 19
"""Of the recording that comes with the SDK, 30 ms: three packets, of which two are whole."""

_PLACE: Final = (-2.0, 50.0, 0.5)
"""Of a bar, east, north and up of a camera that faces north, m."""


def load_kernels(links: Sequence[Link], *, positions: bool = False) -> None:
    """Load a receiver's kernels by frames of drawn bars and a piece of the recording that comes with the SDK.

    Those of `positions` are loaded by a fix.
    """
    for link in links:
        if has_bar_frames(link):
            load_decoder_kernels(link)
        if positions:
            _solve_bar_pose(link)
    receiver, pictures, camera = Receiver(links), PictureSlot(), links[0].camera
    with RawSource(find_shipped_file("recordings", "night-50m-30kmh-cut.raw")) as source:
        for events in islice(source.chunks(1 << 14), _PIECES):
            pictures.request()
            pictures.add(events, camera.width, camera.height, receiver.regions)
            if pictures.newest is not None:
                encode_png(pictures.newest.paint())
            receiver.feed(events)
    receiver.close()


def _solve_bar_pose(link: Link) -> None:
    attitude = Attitude(heading_deg=0.0)
    along = np.linspace(0.5, -0.5, link.bar.clusters)[:, None] * (0.0, 0.0, link.bar.length_m)
    points, _ = project_bars(along + _PLACE, np.zeros(3), attitude.rotation(), link.camera)
    view = BarView(0, along + _PLACE, points, np.full(len(points), 0.3))
    solve_pose([view], link.camera, attitude, ErrorModel.of(link.position), link.camera_sigma)
