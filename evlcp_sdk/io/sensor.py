"""Whether a recording is of the sensor that a receiver is set up for."""

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.scene.camera import CameraModel


def check_sensor(source: EventSource, url: object, camera: CameraModel) -> None:
    """Refuse a recording of another sensor than the camera has; one that does not say its size passes.

    Args:
        source: The recording, open.
        url: What the message calls it.
        camera: That of the link.

    Raises:
        ConfigError: The sizes differ.
    """
    size = (source.width, source.height)
    if None not in size and size != (camera.width, camera.height):
        raise ConfigError(
            f"{url}: recorded with {size[0]} x {size[1]} pixels, but the link's camera has"
            f" {camera.width} x {camera.height}; set camera.width, camera.height and camera.pitch_um"
        )
