"""`evlcp loop`: a text by an emulated board to a simulated camera, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from evlcp_sdk.cli._common import LinkFile, Overrides, console, echo, progress_bar


def loop(
    text: Annotated[str, typer.Option("--text", metavar="TEXT", help="What is sent.")] = "Road works",
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder of all files.")] = Path(
        "loop-out"
    ),
    distance_m: Annotated[
        float, typer.Option("--distance", metavar="M", min=1.0, max=1000.0, help="From camera to bar.")
    ] = 50.0,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=2**32 - 1, help="Seed of the scene: its noise, its start.")
    ] = 0,
    report: Annotated[
        bool, typer.Option("--report", help="Also write received/report.html: the bar in slow motion, plots.")
    ] = False,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Each step as a line of JSON.")] = False,
) -> None:
    """Send a text from end to end on this machine, and read it.

    The board runs the real firmware, compiled here (needs cc and make); the camera is simulated. Ends with 1
    if the text does not arrive.

    Your own text:       [bold]evlcp loop --text "Tempo 30" --distance 60[/]
    At slower chips:     [bold]evlcp loop --set air.chip_rate_hz=5000.0[/]
    """
    import json

    from evlcp_sdk.diagnosis.facts import Diagnostic
    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.plugin.registry import Registry
    from firmware_host.loop import loop as steps

    link = load_link(link_file, overrides or [], Registry.load())
    screen = console()
    if not as_json:
        screen.print(
            "a text from end to end (the first run also compiles firmware and kernels) ...", style="dim"
        )
    done: Mapping[str, Any] = {}
    files: list[str] = []
    sinks = ["report"] if report else []
    with progress_bar("rendering") as bar:

        def advance(share: float) -> None:
            bar(share, 1.0)

        for step in steps(text, link, out, distance_m=distance_m, seed=seed, sinks=sinks, advance=advance):
            done = step.figures
            files += step.files
            if as_json:
                echo(json.dumps({"step": step.name, **done, "files": list(step.files)}))
                continue
            screen.print(f"{step.name:9} {_WORDS[step.name](done)}")
            for warning in done.get("warnings", ()):
                screen.print(f"          warning: {Diagnostic(**warning)}", style="yellow")
    if not as_json:
        screen.print(f"written: {out}/{', '.join(files)}", style="dim")
    if not done["as_sent"]:
        raise typer.Exit(1)


def _message(step: Mapping[str, Any]) -> str:
    packets = "1 packet" if step["packets"] == 1 else f"{step['packets']} packets"
    return (
        f'"{step["text"]}", {step["bytes"]} bytes: {packets} with error correction, {step["bits"]} bits as'
        f" {step['symbols']} symbols in {step['chips']} chips, {1e3 * step['duration_s']:.4g} ms"
    )


def _board(step: Mapping[str, Any]) -> str:
    return (
        f"emulated, firmware {step['firmware']}: programmed over its line ({step['payload_bytes']} bytes),"
        " read back, started"
    )


def _light(step: Mapping[str, Any]) -> str:
    leds = "1 LED" if step["leds"] == 1 else f"{step['leds']} LEDs"
    return (
        f"{leds}, {step['chip_rate_hz']:g} chips a second, on for {step['on_share']:.0%} of the"
        f" time; {step['chips']} chips watched, each what the message says"
    )


def _scene(step: Mapping[str, Any]) -> str:
    return (
        f"a still camera {step['distance_m']:g} m away looks for {step['duration_s']:.2g} s:"
        f" {step['events'] / 1e6:.2f} million events, {step['bytes'] / 1e6:.1f} MB"
    )


def _receiver(step: Mapping[str, Any]) -> str:
    if not step["frames"]:
        return f"{step['result']}; {step['frames_sent']} frames were sent"
    share = step["bit_errors"] / step["bits"] if step["bits"] else 0.0
    return (
        f"{step['frames']} of {step['frames_sent']} frames, {step['bit_errors']} of {step['bits']} bits wrong"
        f" (BER {share:.2g})"
    ) + ("" if step["distance_m"] is None else f"; distance {step['distance_m']:.2f} m")


def _text(step: Mapping[str, Any]) -> str:
    if not step["texts"]:
        return "none was read"
    times = "once" if step["packets"] == 1 else f"from {step['packets']} packets"
    read = ", ".join(f'"{text}"' for text in step["texts"])
    return f"{read}, read {times}" + ("" if step["as_sent"] else ": not what was sent")


_WORDS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "message": _message,
    "board": _board,
    "light": _light,
    "scene": _scene,
    "receiver": _receiver,
    "text": _text,
}
