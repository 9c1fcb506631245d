"""Write bags of ROS 2 without ROS: one MCAP file, its messages packed by `rosbags`."""

from typing import IO, Any, Final

import numpy as np

from evlcp_sdk.errors import import_extra
from evlcp_sdk.io.raw import RawWriter
from evlcp_sdk.values import Events, Triggers

EVENT_PACKET: Final = "event_camera_msgs/msg/EventPacket"

_DEFINITIONS: Final = {
    EVENT_PACKET: "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n"
}
"""Definitions of types that are not ROS 2's own."""

_PACKET_US: Final = 10_000
"""Most time of a packet of events."""


class RosBag:
    """Writes messages of ROS 2 into one MCAP file, as `ros2 bag play` reads it; the file is not closed.

    Raises:
        ConfigError: `mcap` or `rosbags` is not installed.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        writer, typesys = (import_extra(one, "ros", name) for one in ("mcap.writer", "rosbags.typesys"))
        self._store: Any = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for kind, text in _DEFINITIONS.items():
            self._store.register(typesys.get_types_from_msg(text, kind))
        self._writer: Any = writer.Writer(file)
        self._writer.start(profile="ros2", library="evlcp-sdk")
        self._channels: dict[str, int] = {}

    def make_message(self, kind: str, **values: Any) -> Any:
        """Make a message, or a part of one, of a type."""
        return self._store.types[kind](**values)

    def make_header(self, at_ns: int) -> Any:
        """Make the header of a message of the camera."""
        stamp = self.make_message("builtin_interfaces/msg/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        return self.make_message("std_msgs/msg/Header", stamp=stamp, frame_id="camera")

    def write(self, topic: str, message: Any, at_ns: int) -> None:
        """Write a message; the first one of a topic fixes its type."""
        kind = message.__msgtype__
        if topic not in self._channels:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", schema, {"offered_qos_profiles": ""}
            )
        data = bytes(self._store.serialize_cdr(message, kind))
        self._writer.add_message(self._channels[topic], log_time=at_ns, data=data, publish_time=at_ns)

    def finish(self) -> None:
        """Write the file's index."""
        self._writer.finish()


class EventBagWriter(RawWriter):
    """Writes the words of a RAW file as a bag of `event_camera_msgs/EventPacket`, a message every 10 ms.

    Messages are stamped by the camera's clock. The bag reads back as it was written.

    Raises:
        ConfigError: `mcap` or `rosbags` is not installed, or the size of the sensor is unknown or too large.
        OutputError: The file cannot be written.
    """

    topic = "/event_camera/events"
    _seq = 0

    def _begin(self) -> None:
        self._bag = RosBag(self._file, str(self.path))

    def _write(self, events: Events, triggers: Triggers) -> None:
        turns = [np.unique(column // _PACKET_US) for column in (events.t_us, triggers.t_us)]
        ends_us = (np.union1d(*turns) + 1) * _PACKET_US
        i = j = 0
        for end_us, n, m in zip(
            ends_us.tolist(),
            np.searchsorted(events.t_us, ends_us).tolist(),
            np.searchsorted(triggers.t_us, ends_us).tolist(),
            strict=True,
        ):
            self._write_packet(events[i:n], triggers[j:m], end_us)
            i, j = n, m

    def _write_packet(self, events: Events, triggers: Triggers, end_us: int) -> None:
        words = b"".join(self._encoder.encode(events, triggers))
        message = self._bag.make_message(
            EVENT_PACKET,
            header=self._bag.make_header(end_us * 1000),
            height=self.height,
            width=self.width,
            seq=self._seq,
            time_base=0,
            encoding="evt3",
            is_bigendian=False,
            events=np.frombuffer(words, np.uint8),
        )
        self._bag.write(self.topic, message, end_us * 1000)
        self._seq += 1

    def _finish(self) -> None:
        self._bag.finish()
