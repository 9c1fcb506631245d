"""`fixes.mcap`: the results of a run as MCAP with well-known schemas, as they come."""

import json
import math
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.navigator import Place
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.results.columns import FRAME_COLUMNS
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.lines import format_frame, integrity_fields
from evlcp_sdk.results.picture import encode_png, paint_events
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.utc import to_utc_ns
from evlcp_sdk.values import Events, Fix, Packet, Region

FRAME_ID, CAMERA_ID = "enu", "camera"
"""Names of the local axes, and of the camera's: x right, y down, z forward."""

_PICTURE_US, _WINDOW_US = 40_000, 10_000
"""Time from one picture to the next, and time that each shows."""

_WHITE, _AMBER = (1.0, 1.0, 1.0, 0.8), (1.0, 0.75, 0.2, 1.0)

_FRAME = {
    "type": "object",
    "properties": {
        name: {"type": "array", "items": {"type": "integer"}} if name == "symbols" else {"type": "number"}
        for name in FRAME_COLUMNS
    },
}


class Mcap(Sink):
    """Writes `fixes.mcap`, message by message; its topics and their types are in `docs/outputs.md`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        from mcap.writer import Writer

        super().__init__(folder, run)
        self._writer: Any = Writer(folder.open_binary("fixes.mcap"))
        self._writer.start(library="evlcp-sdk")
        self._channels: dict[str, int] = {}
        camera = run.link.camera
        self._cells = np.zeros((camera.height, camera.width), np.uint8)
        self._picture: int | None = None
        self._turn: int | None = None
        self._regions: dict[int, Region] = {}
        self._bars: dict[int, BarSite] = {}

    def events(self, events: Events) -> None:
        """Draw events, and write complete pictures."""
        number, phase_us = np.divmod(events.t_us, _PICTURE_US)
        shown = phase_us >= _PICTURE_US - _WINDOW_US
        number, events = number[shown], events[shown]
        if not len(number):
            return
        for first, last in pairwise([0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)]):
            if self._picture != number[first]:
                self._write_picture()
                self._picture = int(number[first])
            paint_events(self._cells, events[first:last])

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Collect the regions, and write those in the time of a picture together."""
        if stage != "regions":
            return
        turn = int(value.t_us // _PICTURE_US)
        if self._turn != turn:
            self._write_regions()
            self._turn = turn
        self._regions[value.id] = value

    def packet(self, packet: Packet) -> None:
        """Write the frames of a packet."""
        for frame in packet.frames:
            self._write_json("/frames", frame.t_us, format_frame(frame))

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a fix, and the filtered place at its time if it is accepted."""
        from scipy.spatial.transform import Rotation

        self._write_integrity(fix)
        self._write_scene(fix.t_us)
        if filtered is None:
            return
        measured = (fix.latitude_deg, fix.longitude_deg, fix.height_m)
        place = (filtered.latitude_deg, filtered.longitude_deg, filtered.height_m)
        self._write_location("/fix", fix.t_us, measured, fix.covariance_m2)
        self._write_location("/track", fix.t_us, place, filtered.covariance_m2)
        if not math.isfinite(fix.heading_deg):
            return
        axes = Attitude(fix.pitch_deg, fix.roll_deg, fix.heading_deg).rotation()
        turn = Rotation.from_matrix(axes).as_quat()
        pose = _load_schema("PoseInFrame")(frame_id=FRAME_ID)
        pose.timestamp.FromNanoseconds(self._to_ns(fix.t_us))
        where, how = pose.pose.position, pose.pose.orientation
        where.x, where.y, where.z = fix.enu_m.tolist()
        how.x, how.y, how.z, how.w = turn.tolist()
        self._write_message("/pose", fix.t_us, pose)

    def finish(self) -> None:
        """Write the last picture and regions, and the file's index."""
        self._write_picture()
        self._write_regions()
        self._writer.finish()

    def _write_location(
        self, topic: str, t_us: float, place: tuple[float, float, float], covariance_m2: NDArray[np.float64]
    ) -> None:
        latitude, longitude, height = place
        fix = _load_schema("LocationFix")
        message = fix(
            frame_id=FRAME_ID,
            latitude=latitude,
            longitude=longitude,
            altitude=height,
            position_covariance=covariance_m2.ravel().tolist(),
            position_covariance_type=fix.KNOWN,
        )
        message.timestamp.FromNanoseconds(self._to_ns(t_us))
        self._write_message(topic, t_us, message)

    def _write_integrity(self, fix: Fix) -> None:
        from google.protobuf.struct_pb2 import Struct

        message = Struct()
        message.update({"bars": list(fix.transmitters), "refusal": fix.refusal} | integrity_fields(fix))
        self._write_message("/integrity", fix.t_us, message)

    def _write_picture(self) -> None:
        if self._picture is None:
            return
        end_us = (self._picture + 1) * _PICTURE_US
        image = _load_schema("CompressedImage")(
            frame_id=CAMERA_ID, data=encode_png(self._cells), format="png"
        )
        image.timestamp.FromNanoseconds(self._to_ns(end_us))
        self._write_message("/image", end_us, image)
        self._cells[:] = 0
        self._picture = None

    def _write_regions(self) -> None:
        if self._turn is None:
            return
        end_us = (self._turn + 1) * _PICTURE_US
        message, loop = _load_schema("ImageAnnotations")(), _load_schema("PointsAnnotation").LINE_LOOP
        for region in self._regions.values():
            box = message.points.add(type=loop, thickness=1)
            box.timestamp.FromNanoseconds(self._to_ns(end_us))
            box.outline_color.r, box.outline_color.g, box.outline_color.b, box.outline_color.a = _WHITE
            for right, down in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                box.points.add(
                    x=region.x_px + right * (region.width_px / 2 + 2),
                    y=region.y_px + down * (region.height_px / 2 + 2),
                )
        self._write_message("/regions", end_us, message)
        self._regions.clear()
        self._turn = None

    def _write_scene(self, t_us: float) -> None:
        """Write the bars if the place of one has become known or changed."""
        assert self.run.navigator is not None
        positioner = self.run.navigator.positioner
        axes, bars = positioner.axes, dict(positioner.bars.known_sites)
        if axes is None or bars == self._bars:
            return
        message = _load_schema("SceneUpdate")()
        for number, site in bars.items():
            bar = message.entities.add(frame_id=FRAME_ID, id=f"bar {number}", frame_locked=True)
            bar.timestamp.FromNanoseconds(self._to_ns(t_us))
            line = bar.lines.add(type=_load_schema("LinePrimitive").LINE_STRIP, thickness=0.05)
            line.pose.orientation.w = 1
            line.color.r, line.color.g, line.color.b, line.color.a = _AMBER
            middle = axes.to_enu(site.latitude_deg, site.longitude_deg, site.height_m)
            for end in (-0.5, 0.5):
                east, north, up = (middle + end * site.length_m * site.axis_enu()).tolist()
                line.points.add(x=east, y=north, z=up)
            text = bar.texts.add(text=f"bar {number}, id {site.transmitter_id}", font_size=12)
            text.billboard = text.scale_invariant = True
            text.color.r, text.color.g, text.color.b, text.color.a = _AMBER
            text.pose.orientation.w = 1
            text.pose.position.x, text.pose.position.y, text.pose.position.z = middle.tolist()
        self._write_message("/scene", t_us, message)
        self._bars = bars

    def _write_message(self, topic: str, t_us: float, message: Any) -> None:
        from mcap_protobuf.schema import register_schema

        if topic not in self._channels:
            schema = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema)
        self._add_message(topic, t_us, message.SerializeToString())

    def _write_json(self, topic: str, t_us: float, text: str) -> None:
        if topic not in self._channels:
            schema = self._writer.register_schema("evlcp.Frame", "jsonschema", json.dumps(_FRAME).encode())
            self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        self._add_message(topic, t_us, text.encode())

    def _add_message(self, topic: str, t_us: float, data: bytes) -> None:
        log_ns = self._to_ns(t_us)
        self._writer.add_message(self._channels[topic], log_time=log_ns, data=data, publish_time=log_ns)

    def _to_ns(self, t_us: float) -> int:
        return to_utc_ns(self.run.clock_zero, t_us)


def _load_schema(name: str) -> Any:
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
