"""`evlcp score`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from evlcp_sdk.cli._common import Json, console, print_json
from evlcp_sdk.cli._complain import complain


def score(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="What `evlcp receive -o OUT` wrote.")],
    truth_file: Annotated[Path, typer.Argument(metavar="REC.truth.json", help="The recording's truth.")],
    as_json: Json = False,
) -> None:
    """Hold a result against the truth: frames, bits, distances.

    [bold]evlcp score out REC.truth.json[/]

    Each row of OUT/frames.csv is put beside the true frame that started nearest in time, on the bar nearest
    in the image. There are two scores: the plain one, for which a symbol that is not given counts as all bits
    wrong; and the road score, which knows erased symbols, hidden clusters and reflections.

    A result of another link than that of the truth is refused.
    """
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.sim.truth import read_truth
    from evlcp_sdk.study.frames import read_frames
    from evlcp_sdk.study.match import check_link
    from evlcp_sdk.study.score import links_of_result, score_frames

    registry = Registry.load()
    links = links_of_result(folder, registry)
    frames = read_frames(folder)
    truth = read_truth(truth_file, registry)
    if not links:
        complain(f"{folder}/summary.json: not there, so nothing says with which link it was received")
    else:
        check_link(truth, links, str(folder))
    for warning in truth.warnings:
        complain(warning)
    found = score_frames(frames, truth, links if len(links) > 1 else None)
    if as_json:
        print_json(found)
        return
    screen = console()
    screen.print(f"rows {found['rows']}, matching no true frame {found['unmatched']}")
    for i, bar in enumerate(found["bars"]):
        screen.print(
            f"bar {i}{_sender(bar)}: frames {bar['frames_found']}/{bar['frames_sent']}  BER {bar['ber']}"
            f"  RMSE {bar['rmse_m']} m over {bar['ranged']}  >=0.5 m: {bar['over_half_metre']}"
        )
        _show_segments(bar)
    road = found["road"]
    screen.print(
        f"road: rows {road['rows']}, matching no true frame {road['unmatched']},"
        f" said to be reflections {road['echoes']}"
    )
    for i, bar in enumerate(road["bars"]):
        screen.print(
            f"bar {i}{_sender(bar)}: frames {bar['frames_found']}/{bar['frames_sent']}  BER {bar['ber']}"
            f"  erased {bar['erased']}  claimed {bar['claimed']}"
            f"  RMSE {bar['rmse_m']} m over {bar['ranged']}  bias {bar['bias_m']}  worst {bar['worst_m']}"
            f"  NEES {bar['nees']}  >=0.5 m: {bar['over_half_metre']}"
        )
        _show_segments(bar)


def _sender(bar: Mapping[str, Any]) -> str:
    """The link of a bar, where the result is of several."""
    return f" ({bar['link']})" if "link" in bar else ""


def _show_segments(bar: Mapping[str, Any]) -> None:
    for name, segment in bar["segments"].items():
        console().print(
            f"   {name}: RMSE {segment['rmse_m']} m, bias {segment['bias_m']} m, n {segment['n']}"
        )
