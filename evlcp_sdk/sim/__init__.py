"""Scenes and the sensor: recordings of any bar, road and light, with their truth."""

from evlcp_sdk.sim.scene import (
    BackgroundSpec,
    BarSpec,
    LampSpec,
    LensSpec,
    MotionSpec,
    Scene,
    SensorSpec,
    WorldSpec,
    load_scene,
    preset_names,
    preset_text,
    resolve_scene,
)
from evlcp_sdk.sim.simulation import Simulation, scene_table, simulate
from evlcp_sdk.sim.truth import scene_of_truth, truth, truth_of
from evlcp_sdk.sim.world import sites_of

__all__ = [
    "BackgroundSpec",
    "BarSpec",
    "LampSpec",
    "LensSpec",
    "MotionSpec",
    "Scene",
    "SensorSpec",
    "Simulation",
    "WorldSpec",
    "load_scene",
    "preset_names",
    "preset_text",
    "resolve_scene",
    "scene_of_truth",
    "scene_table",
    "simulate",
    "sites_of",
    "truth",
    "truth_of",
]
