"""Scenes and the sensor: recordings of any bar, road and light, with their truth."""

from evlcp_sdk.sim.scene import (
    BackgroundSpec,
    BarSpec,
    LampSpec,
    LensSpec,
    MotionSpec,
    Scene,
    SensorSpec,
    load_scene,
    preset_names,
    preset_text,
    resolve_scene,
)
from evlcp_sdk.sim.simulation import Simulation, scene_table, simulate
from evlcp_sdk.sim.truth import scene_of_truth, truth, truth_of

__all__ = [
    "BackgroundSpec",
    "BarSpec",
    "LampSpec",
    "LensSpec",
    "MotionSpec",
    "Scene",
    "SensorSpec",
    "Simulation",
    "load_scene",
    "preset_names",
    "preset_text",
    "resolve_scene",
    "scene_of_truth",
    "scene_table",
    "simulate",
    "truth",
    "truth_of",
]
