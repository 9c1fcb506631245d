"""Kernels loaded before anything is live."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np

from evlcp_sdk.files import shipped
from evlcp_sdk.io.raw import RawSource
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.pictures import PictureSlot
from evlcp_sdk.place.observations import BarView, project_bars
from evlcp_sdk.place.pose import solve_pose
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.values import Events

__all__ = ["warm_up"]

_WARM_US = 30_000
"""Of the recording that comes with the SDK: three packets, of which two are whole."""


_PLACES: Final = ((-4.0, 50.0, 4.5), (4.0, 50.0, 5.5), (0.0, 40.0, 3.5))
"""Of bars, east, north and up of a camera that looks north and up, m: not in line."""

_PITCH_DEG: Final = 5.0
_NOISE_PX: Final = 0.3
_OFF_PX: Final = (0.0, 0.9, 6.0)
"""Of a bar: none; three sigmas, which is doubted; twenty, so that fits without each bar are tried."""

_OFF_SIGMAS: Final = (0.0, *(2.0 + step / 4 for step in range(11)))
"""Of an attitude: none; so many that it is doubted, up to where it is taken for wrong."""


def warm_up(links: Sequence[Link], *, positions: bool = False) -> None:
    """Load what receiving needs, by receiving a piece of the recording that comes with the SDK.

    Then the same again as a camera sees it that shakes, at half of the light: what reads a doubtful frame a
    second time is needed then.

    Args:
        links: What will be received.
        positions: Load what positions need, too, by a fix of each kind of bars that are made up.
    """
    if positions:
        for link in links:
            _find_places(link)
    for shaking in (False, True):
        receiver, pictures, camera = Receiver(links), PictureSlot(), links[0].camera
        with RawSource(shipped("recordings", "night-50m-30kmh-cut.raw")) as source:
            first_us = None
            for events in source.chunks(1 << 14):
                first_us = int(events.t_us[0]) if first_us is None else first_us
                shown = _shaken(events) if shaking else events
                pictures.ask()
                pictures.add(shown, camera.width, camera.height, receiver.regions)
                if pictures.newest is not None:
                    pictures.newest.image().png()
                receiver.feed(shown)
                if int(events.t_us[0]) > first_us + _WARM_US:
                    break
        receiver.close()


def _find_places(link: Link) -> None:
    """Solve for a camera that sees one, two, three bars, with as much known of its attitude as that needs."""
    rng = np.random.default_rng(1)
    rotation = Attitude(_PITCH_DEG).rotation()
    along = np.linspace(0.5, -0.5, link.bar.clusters)[:, None] * (0.0, 0.0, link.bar.length_m)
    knowledge = (Attitude(_PITCH_DEG, heading_deg=0.0), Attitude(_PITCH_DEG), None)
    for bars, known in enumerate(knowledge, 1):
        for off_px, off_sigmas in product(_OFF_PX, _OFF_SIGMAS):
            views = []
            for number, place in enumerate(_PLACES[:bars]):
                points, _ = project_bars(along + place, np.zeros(3), rotation, link.camera)
                points += rng.normal(0, _NOISE_PX, points.shape) + off_px * (number == 0)
                views.append(BarView(number, along + place, points, np.full(len(points), _NOISE_PX)))
            said = known
            if known is not None:
                said = replace(known, pitch_deg=known.pitch_deg + off_sigmas * known.gravity_sigma_deg)
            solve_pose(views, link.camera, said, link.position, link.camera_sigma)


def _shaken(events: Events) -> Events:
    """Every second event, two pixels to and fro in three milliseconds: within a frame."""
    some = events[::2]
    shift_px = np.rint(2 * np.sin(2 * np.pi / 3000 * some.t_us)).astype(np.int64)
    return Events.of(some.t_us, some.x + shift_px, some.y, some.p)
