"""Detection by the rhythm of the chips, and of the whole image as one region."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.plugin.roles import Detection, Detector
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Region


@dataclass(frozen=True)
class Rhythmic(Detection):
    """What blinks in the rhythm of the chips; its parameters are the table `[regions]`."""

    rhythmic: ClassVar[bool] = True

    def compile(self, camera: CameraModel, codebook: Codebook, packet: PacketFormat) -> Detector:
        """Never called: the receiver has a tracker of its own."""
        raise NotImplementedError


@dataclass(frozen=True)
class Whole(Detection):
    """The whole image is one region while there are events: for lists without places, and photodiodes."""

    pause_us: Annotated[
        int, Field(ge=1000, description="Time without any event after which it is another transmitter.")
    ] = 1_000_000

    def compile(self, camera: CameraModel, codebook: Codebook, packet: PacketFormat) -> Detector:
        """For the size of the sensor."""
        return _WholeImage(camera.width, camera.height, self.pause_us)


@dataclass(frozen=True)
class _State:
    """Number of the region, and the time of the last event, us; None before the first."""

    number: int = 0
    last_us: int | None = None


@dataclass(frozen=True)
class _WholeImage:
    width: int
    height: int
    pause_us: int

    def init(self) -> _State:
        return _State()

    def step(self, state: _State, start_us: int, events: Events) -> tuple[_State, list[Region]]:
        if len(events):
            is_new = state.last_us is not None and int(events.t_us[0]) - state.last_us > self.pause_us
            state = _State(state.number + is_new, int(events.t_us[-1]))
        if state.last_us is None or start_us - state.last_us > self.pause_us:
            return state, []
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return state, [Region(state.number, float(start_us), *centre, float(self.width), float(self.height))]
