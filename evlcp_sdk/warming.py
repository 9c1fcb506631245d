"""Kernels compiled before they are needed, by doing once what needs them."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evlcp_sdk.io.open import open_source, write_events
from evlcp_sdk.kernels import count_compiled, find_cache_folder
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.navigator import PositionPlan
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from evlcp_sdk.scene.sites import load_sites
from evlcp_sdk.simulated import simulate
from evlcp_sdk.values import Events

STEPS = ("simulate", "receive", "positions", "formats")
"""What is done, in this order."""

_SCENE = """
name = "warm-up"
duration_s = 0.2
[world]
latitude_deg = 35.1
longitude_deg = 137.2
heading_deg = 30.0
[[bars]]
payload = "messages"
x_m = -2.0
seed = 1
[[bars]]
payload = "messages"
x_m = 2.0
z_m = 4.0
seed = 2
[[bars]]
payload = "messages"
y_m = -0.8
z_m = 8.0
lean_deg = 89.0
seed = 3
"""
"""Three bars, so that positions are found from their directions alone, too."""


@dataclass(frozen=True)
class Warmth:
    """What a warm-up took.

    Attributes:
        compiled: Kernels that were not there and are now.
        elapsed_s: Time on the clock, s.
        kept_in: A folder that they are kept in; None where none can be written, so that the next process
            compiles them again.
    """

    compiled: int
    elapsed_s: float
    kept_in: Path | None


def warm_up(advance: Callable[[str], None] = lambda _step: None) -> Warmth:
    """Simulate and receive a fifth of a second with the default link, with positions, and each file format.

    What that compiles is kept for later processes.

    Args:
        advance: Called with the name of a step of `STEPS` when it begins.
    """
    registry = Registry.load()
    link = load_link(None, registry=registry)
    compiled, began_s = count_compiled(), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="evlcp-warm-up-") as name:
        folder = Path(name)
        scene, recording = folder / "scene.toml", folder / "scene.raw"
        advance("simulate")
        scene.write_text(_SCENE)
        simulate(scene).save(recording)
        advance("receive")
        receive_to_folder(recording, folder / "out", link, registry=registry)
        advance("positions")
        log = AttitudeLog.read(folder / "scene.attitude.csv", Attitude())
        plan = PositionPlan(load_sites(folder / "scene.site.toml"))
        receive_to_folder(recording, None, link, registry=registry, plan=plan, attitude=log)
        advance("formats")
        with open_source(recording, registry) as source:
            events = source.take(1000)
        assert events is not None
        for table in ("events.csv", "events.raw"):
            _written_and_read(events[0], folder / table, source.width, source.height, registry)
    return Warmth(count_compiled() - compiled, time.perf_counter() - began_s, find_cache_folder())


def _written_and_read(
    events: Events, path: Path, width: int | None, height: int | None, registry: Registry
) -> None:
    write_events(path, events, width, height)
    with open_source(path, registry) as source:
        while source.take(1000) is not None:
            pass
