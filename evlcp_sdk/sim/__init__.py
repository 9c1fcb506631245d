"""Scenes and the sensor: recordings of any bar, road and light, with their truth."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evlcp_sdk.sim.record import scene_of_truth, truth_of
    from evlcp_sdk.sim.scene import (
        BackgroundSpec,
        BarSpec,
        LampSpec,
        LensSpec,
        MotionSpec,
        ReflectionSpec,
        Scene,
        SensorSpec,
        WiperSpec,
        WorldSpec,
        load_scene,
        preset_names,
        preset_text,
        resolve_scene,
    )
    from evlcp_sdk.sim.simulation import Simulation, scene_table, simulate
    from evlcp_sdk.sim.truth import SentBar, Truth, read_truth, truth_from_table, truth_path
    from evlcp_sdk.sim.world import sites_of

__all__ = [
    "BackgroundSpec",
    "BarSpec",
    "LampSpec",
    "LensSpec",
    "MotionSpec",
    "ReflectionSpec",
    "Scene",
    "SensorSpec",
    "SentBar",
    "Simulation",
    "Truth",
    "WiperSpec",
    "WorldSpec",
    "load_scene",
    "preset_names",
    "preset_text",
    "read_truth",
    "resolve_scene",
    "scene_of_truth",
    "scene_table",
    "simulate",
    "sites_of",
    "truth_from_table",
    "truth_of",
    "truth_path",
]

_HOMES = {
    "record": ("scene_of_truth", "truth_of"),
    "scene": (
        "BackgroundSpec",
        "BarSpec",
        "LampSpec",
        "LensSpec",
        "MotionSpec",
        "ReflectionSpec",
        "Scene",
        "SensorSpec",
        "WiperSpec",
        "WorldSpec",
        "load_scene",
        "preset_names",
        "preset_text",
        "resolve_scene",
    ),
    "simulation": ("Simulation", "scene_table", "simulate"),
    "truth": ("SentBar", "Truth", "read_truth", "truth_from_table", "truth_path"),
    "world": ("sites_of",),
}
"""Where each name is: the kernels are imported by what renders, not by a truth."""


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
