"""A simulation as a source of events, like a recording or a camera."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError, StreamError
from evlcp_sdk.files import Outputs, check_output
from evlcp_sdk.formatting import format_count
from evlcp_sdk.io.open import open_writer
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.scene.sites import to_toml
from evlcp_sdk.sim import Scene, Simulation, Truth, load_scene, resolve_scene, truth_of, truth_path
from evlcp_sdk.sim.world import attitude_log, survey_sites
from evlcp_sdk.values import Events, Triggers

Advance = Callable[[float], None]


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
        """What was sent and where the bars are, in the whole scene whether it has been read or not."""
        return truth_of(self.simulation)

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Render on until there are events, and return them; None at the scene's end."""
        events = next(self._pieces, None)
        return None if events is None else (events, Triggers.empty())

    def close(self) -> None:
        """Stop rendering."""
        self._pieces = iter(())

    def save(self, path: Path | str, advance: Advance | None = None) -> tuple[Path, ...]:
        """Render the scene into a recording with its truth; return the files that were written.

        `NAME.raw` (EVT3) and `NAME.truth.json`; of a scene on earth also `NAME.site.toml`, where its bars
        stand, and `NAME.attitude.csv`, what an IMU measures. They come into place together, the truth last.

        Args:
            path: `NAME.raw`.
            advance: Called after every piece with the seconds of the scene rendered so far.

        Raises:
            StreamError: Events of the source have been taken already.
            ConfigError: The file's name does not end in `.raw`.
            OutputError: A file cannot be written.
        """
        out, simulation = Path(path), self.simulation
        if out.suffix != ".raw":
            raise ConfigError(f"{out}: a recording is written as NAME.raw")
        if simulation.done_s:
            raise StreamError(f"{out}: the simulation has been read already; simulate it again to save it")
        truth_file = truth_path(out)
        check_output(truth_file)
        # What they refuse is reported before the rendering.
        survey = _survey_files(simulation, out)
        with Outputs() as outputs:
            with open_writer(out, self.width, self.height, "EVT3", outputs) as writer:
                for events in self._pieces:
                    writer.write(events)
                    if advance is not None:
                        advance(simulation.done_s)
            for path, text in survey.items():
                outputs.write_text(text, path)
            size = outputs.path(out).stat().st_size
            outputs.write_text(json.dumps({**self.truth.table, "bytes": size}), truth_file)
        return (out, truth_file, *survey)

    @property
    def counts(self) -> dict[str, int]:
        """Events given out so far, and the sensor's counts: its events, those dropped, those of light."""
        return super().counts | {
            f"simulated_{name}": number for name, number in self.simulation.counts.items()
        }

    def __repr__(self) -> str:
        scene = self.scene
        bars = format_count(len(scene.bars), "bar")
        return f"SimulatedSource({scene.name}, {bars}, {scene.duration_s:g} s, seed {scene.seed})"


def _survey_files(simulation: Simulation, out: Path) -> dict[Path, str]:
    """Files with the sites of the bars and the camera's attitude, text by path; none off the earth."""
    scene = simulation.scene
    if scene.world is None:
        return {}
    files = {out.with_suffix(".site.toml"): to_toml(survey_sites(scene, scene.seed))}
    log = attitude_log(scene, scene.seed, simulation.path)
    if log is not None:
        files[out.with_suffix(".attitude.csv")] = log.to_csv()
    return files


def simulate(
    scene: str | Path | Mapping[str, Any] | Scene,
    seed: int | None = None,
    *,
    link: Link | Path | str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    threads: int = 1,
) -> SimulatedSource:
    """Render a scene as a source of events, with its truth.

    Args:
        scene: A preset's name, a `scene.toml`, its table, or a loaded scene.
        seed: Seed of everything random, instead of the scene's.
        link: A link or a `link.toml` that the bars send with, instead of the scene's; of a preset or a file.
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
        scene = load_scene(scene, overrides, link=link)
    elif overrides or link is not None:
        raise ConfigError("link and overrides are of a preset or a file; write them into the scene's table")
    if isinstance(scene, Mapping):
        scene = resolve_scene(scene)
    return SimulatedSource(Simulation(scene, seed, threads))
