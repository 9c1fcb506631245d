"""A simulation as a source of events, like a recording or a camera."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.io.sources import EventSource
from evlcp_sdk.sim import Scene, Simulation, Truth, load_scene, resolve_scene, truth_of
from evlcp_sdk.values import Events, Triggers

__all__ = ["SimulatedSource", "simulate"]


class SimulatedSource(EventSource):
    """A scene that is rendered while it is read, once from front to back; `receive` takes it as it is.

    Args:
        simulation: What is rendered.

    Attributes:
        simulation: The same.
    """

    def __init__(self, simulation: Simulation) -> None:
        camera = simulation.scene.camera
        super().__init__(Path(simulation.scene.name), "SIMULATED", camera.width, camera.height)
        self.simulation = simulation
        self._pieces = simulation.stream()

    @property
    def scene(self) -> Scene:
        """What is rendered, with its seed."""
        return self.simulation.scene

    @property
    def truth(self) -> Truth:
        """What was sent and where the bars are, all of the scene whether it has been read or not."""
        return truth_of(self.simulation)

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Render on until there are events; return them, or None at the scene's end."""
        events = next(self._pieces, None)
        return None if events is None else (events, Triggers.empty())

    def close(self) -> None:
        """Stop rendering."""
        self._pieces = iter(())

    @property
    def counts(self) -> dict[str, int]:
        """Events given out so far, and what the sensor did: its events, those dropped, those of light."""
        return super().counts | {
            f"simulated_{name}": number for name, number in self.simulation.counts.items()
        }

    def __repr__(self) -> str:
        scene = self.scene
        number = len(scene.bars)
        bars = f"{number} bar{'s' * (number != 1)}"
        return f"SimulatedSource({scene.name}, {bars}, {scene.duration_s:g} s, seed {scene.seed})"


def simulate(
    scene: str | Path | Mapping[str, Any] | Scene,
    seed: int | None = None,
    *,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    threads: int = 1,
) -> SimulatedSource:
    """Render a scene as a source of events, with its truth.

    Args:
        scene: A preset's name, a `scene.toml`, its table, or a scene that is loaded.
        seed: Of everything random, instead of the scene's.
        overrides: What `--set` takes, e.g. `"motion.distance_m=70"`, or a mapping from key to value; of a
            preset or a file.
        threads: Threads that share the pixels; the events do not depend on it.

    Raises:
        ConfigError: The scene cannot be read or rendered.
        InputError: One of its files cannot be read.

    >>> simulate("night", seed=1, overrides=["duration_s=0.1"])
    SimulatedSource(night, 1 bar, 0.1 s, seed 1)
    """
    if isinstance(scene, str | Path):
        scene = load_scene(scene, overrides)
    elif overrides:
        raise ConfigError("overrides are of a preset or a file; write the values into the scene's table")
    if isinstance(scene, Mapping):
        scene = resolve_scene(scene)
    return SimulatedSource(Simulation(scene, seed, threads))
