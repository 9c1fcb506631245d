"""Scenes and the sensor: recordings of any bar, road and light, with their truth."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evlcp_sdk.sim.record import truth_of as truth_of
    from evlcp_sdk.sim.scene import (
        BackgroundSpec as BackgroundSpec,
        BarSpec as BarSpec,
        DropSpec as DropSpec,
        LampSpec as LampSpec,
        LensSpec as LensSpec,
        MotionSpec as MotionSpec,
        ReflectionSpec as ReflectionSpec,
        Scene as Scene,
        SensorSpec as SensorSpec,
        WiperSpec as WiperSpec,
        WorldSpec as WorldSpec,
        load_scene as load_scene,
        preset_names as preset_names,
        preset_text as preset_text,
        resolve_scene as resolve_scene,
    )
    from evlcp_sdk.sim.simulation import Simulation as Simulation
    from evlcp_sdk.sim.truth import (
        SentBar as SentBar,
        Truth as Truth,
        read_truth as read_truth,
        truth_from_table as truth_from_table,
        truth_path as truth_path,
    )
    from evlcp_sdk.sim.world import sites_of as sites_of

_HOMES = {
    "record": "truth_of",
    "scene": (
        "BackgroundSpec BarSpec DropSpec LampSpec LensSpec MotionSpec ReflectionSpec Scene SensorSpec "
        "WiperSpec WorldSpec load_scene preset_names preset_text resolve_scene"
    ),
    "simulation": "Simulation",
    "truth": "SentBar Truth read_truth truth_from_table truth_path",
    "world": "sites_of",
}
"""The module of each name: rendering takes half a second to import, which reading a truth does not need."""

__all__ = sorted(" ".join(_HOMES.values()).split())


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names.split():
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
