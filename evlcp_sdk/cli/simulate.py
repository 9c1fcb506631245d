"""`evlcp simulate`."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, Overrides, console, echo, print_json, progress_bar
from evlcp_sdk.formatting import format_count


def simulate(
    scene_file: Annotated[
        str | None, typer.Argument(metavar="[scene.toml]", help="The scene; or use --preset.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="REC.raw", help="The recording to write.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(metavar="NAME", help="A scene that comes with the package.")
    ] = None,
    link: Annotated[
        str | None,
        typer.Option("-c", "--config", metavar="link.toml", help="Link of the bars, instead of the scene's."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of everything random, instead of the scene's.")
    ] = None,
    overrides: Overrides = None,
    threads: Annotated[int, typer.Option(min=1, max=256, help="Threads; the recording is the same.")] = 1,
    presets: Annotated[bool, typer.Option("--presets", help="List the presets and end.")] = False,
    show: Annotated[
        bool, typer.Option("--show", help="Print the preset's TOML, to start a scene from, and end.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Render a scene: REC.raw (EVT3) and its truth, REC.truth.json.

    A scene that says where on earth it is also gives REC.site.toml, where its bars stand, and
    REC.attitude.csv, what an IMU measures, for [bold]evlcp receive --sites[/].

    A scene of yours:      [bold]evlcp simulate scene.toml -o REC.raw[/]
    A preset, varied:      [bold]evlcp simulate --preset night -o REC.raw --set motion.distance_m=70[/]
    Your link on air:      [bold]evlcp simulate --preset night -c link.toml -o REC.raw[/]
    Slower chips:          [bold]evlcp simulate --preset night -o REC.raw --set link.air.chip_rate_hz=5e3[/]
    What presets there are: [bold]evlcp simulate --presets[/]
    A scene to start from:  [bold]evlcp simulate --preset night --show > scene.toml[/]
    """
    if presets:
        _list_presets(as_json=as_json)
        return
    if show:
        if preset is None or scene_file or overrides or link:
            raise typer.BadParameter(
                "prints a --preset as it is, nothing else beside it", param_hint="--show"
            )
        echo(sdk.scene.preset_text(preset), nl=False)
        return
    source = _choose_source(scene_file, preset)
    if out is None:
        raise typer.BadParameter("where should the recording go?", param_hint="-o REC.raw")
    _render(source, out, seed, link, overrides or [], threads, as_json=as_json)


def _list_presets(*, as_json: bool) -> None:
    if as_json:
        print_json(sdk.scene.preset_names())
        return
    for name in sdk.scene.preset_names():
        comments = (
            line.lstrip("# ") for line in sdk.scene.preset_text(name).splitlines() if line.startswith("#")
        )
        console().print(f"{name:14} {next(comments, '')}")


def _choose_source(scene_file: str | None, preset: str | None) -> Path | str:
    if (scene_file is None) == (preset is None):
        raise typer.BadParameter("name either a scene.toml or a --preset", param_hint="scene.toml")
    if preset is not None:
        sdk.scene.preset_text(preset)  # raises if there is none
        return preset
    assert scene_file is not None
    if scene_file in sdk.scene.preset_names() and not os.path.lexists(scene_file):
        raise typer.BadParameter(
            f"{scene_file}: no such file; for the preset: --preset {scene_file}", param_hint="scene.toml"
        )
    return Path(scene_file)


def _render(
    source: Path | str,
    out: Path,
    seed: int | None,
    link: str | None,
    overrides: list[str],
    threads: int,
    *,
    as_json: bool,
) -> None:
    simulated = sdk.simulated.simulate(source, seed, link=link, overrides=overrides, threads=threads)
    scene = simulated.scene
    start_s = time.perf_counter()
    with progress_bar(out.name) as advance:
        written = simulated.save(out, lambda done_s: advance(done_s, scene.duration_s))
    elapsed_s = time.perf_counter() - start_s
    counts = simulated.simulation.counts
    size = out.stat().st_size
    summary: dict[str, Any] = {
        "recording": str(out),
        "truth": str(written[1]),
        "name": scene.name,
        "seed": scene.seed,
        "duration_s": scene.duration_s,
        "bytes": size,
        **counts,
        "elapsed_s": round(elapsed_s, 6),
        "events_per_s": round(counts["events"] / elapsed_s),
    }
    if as_json:
        print_json(summary)
        return
    screen = console()
    screen.print(
        f"{out.name}: {counts['events'] / 1e6:.2f} Mev in {scene.duration_s:g} s of time,"
        f" {size / 1e6:.1f} MB; rendered in {elapsed_s:.1f} s"
        f" ({summary['events_per_s'] / 1e6:.1f} Mev/s)"
    )
    if counts["dropped_by_rate_cap"]:
        screen.print(
            f"lost to the event-rate limit: {format_count(counts['dropped_by_rate_cap'], 'event')}",
            style="yellow",
        )
    screen.print(f"written: {', '.join(map(str, written))}", style="dim")
