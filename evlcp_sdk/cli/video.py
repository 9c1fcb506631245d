"""`evlcp video`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, LinkFiles, Overrides, console, print_json, progress_bar
from evlcp_sdk.formatting import format_count

From = Annotated[
    float | None,
    typer.Option(
        "--from-ms",
        min=0,
        help="Start, after the first event.  [default: the first frame that is decoded]",
        show_default=False,
    ),
]


def video(
    recording: Annotated[
        str, typer.Argument(metavar="REC", help="A recording, or what a plugin can open twice.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILM", help="The film: NAME.webp, NAME.gif or NAME.mp4.")
    ],
    link_files: LinkFiles = None,
    overrides: Overrides = None,
    from_ms: From = None,
    for_ms: Annotated[float, typer.Option(min=0.001, help="How much of the recording to show.")] = 20.0,
    slow: Annotated[float, typer.Option(min=1, help="How many times slower than it was.")] = 400.0,
    size: Annotated[
        int, typer.Option(min=64, max=1280, metavar="PX", help="Longest side of the picture.")
    ] = 640,
    whole: Annotated[bool, typer.Option("--whole", help="Show the whole image, not the bars only.")] = False,
    as_json: Json = False,
) -> None:
    """Film the events in slow motion, and what was read from them.

    The first frames:     [bold]evlcp video REC.raw -o REC.webp[/]
    More, and faster:     [bold]evlcp video REC.raw -o REC.webp --for-ms 100 --slow 100[/]
    A second later:       [bold]evlcp video REC.raw -o REC.webp --from-ms 1000[/]
    All that is in view:  [bold]evlcp video REC.raw -o REC.gif --whole --size 1280[/]

    Yellow is where it gets brighter, blue where darker, at 1/400 chip by chip; in faster films a picture
    shows the last chip before it. Beside a bar stand the symbols of the frame that is on air, above it its
    number and distance. Browsers show both WebP and GIF; .mp4, for all other
    programs, takes the extra: [bold]pip install 'evlcp-sdk[mp4]'[/]
    """
    links = sdk.several.load_links(link_files, overrides or [])
    with progress_bar(Path(recording).name, by_bytes=True) as advance:
        summary = sdk.run.film(
            recording,
            out,
            links,
            from_ms=from_ms,
            for_ms=for_ms,
            slow=slow,
            longest_px=size,
            whole=whole,
            advance=advance,
        )
    if as_json:
        print_json(summary)
    else:
        _print_film(summary, Path(recording).name)


def _print_film(film: dict[str, Any], name: str) -> None:
    screen = console()
    if film["frames"]:
        transmitters = format_count(len(film["transmitters"]), "transmitter")
        content = f"{transmitters}, {format_count(film['frames'], 'frame')}"
    else:
        content = "no frame is decoded there"
    screen.print(
        f"{name}: {film['for_ms']:g} ms from {film['from_ms']:.1f} ms on, at 1/{film['slow']:g}; {content}"
    )
    screen.print(
        f"written: {film['film']}, {film['pictures']} pictures of {film['width']} x {film['height']} px,"
        f" {film['bytes'] / 1e6:.1f} MB",
        style="dim",
    )
