"""`evlcp score`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, console, print_json
from evlcp_sdk.cli._stderr import print_stderr


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
    links = sdk.score.links_of_result(folder)
    frames = sdk.frames.read_frames(folder)
    truth = sdk.truth.read_truth(truth_file)
    if not links:
        print_stderr(f"{folder}/summary.json: not there, so nothing says with which link it was received")
    else:
        sdk.match.check_link(truth, links, str(folder))
    for warning in truth.warnings:
        print_stderr(warning)
    table = sdk.score.score_frames(frames, truth, links if len(links) > 1 else None)
    if frames and not any(bar["frames_found"] for bar in table["bars"]):
        print_stderr(
            f"warning: no row of {folder} matches {truth_file}: another recording's, by times or places"
        )
    if as_json:
        print_json(table)
        return
    screen = console()
    for kind, part in (("", table), ("road: ", table["road"])):
        echoes = f", said to be reflections {part['echoes']}" if "echoes" in part else ""
        screen.print(f"{kind}rows {part['rows']}, matching no true frame {part['unmatched']}{echoes}")
        for i, bar in enumerate(part["bars"]):
            sender = f" ({bar['link']})" if "link" in bar else ""
            shown = {key: "-" if value is None else value for key, value in bar.items()}
            figures = "  ".join(form.format(**shown) for key, form in _FIGURES.items() if key in bar)
            screen.print(f"bar {i}{sender}: frames {bar['frames_found']}/{bar['frames_sent']}  {figures}")
            for name, segment in bar["segments"].items():
                form = "   {}: RMSE {rmse_m} m, bias {bias_m} m, n {n}"
                screen.print(form.format(name, **segment))


_FIGURES = {
    "ber": "BER {ber}",
    "erased": "erased {erased}",
    "claimed": "claimed {claimed}",
    "rmse_m": "RMSE {rmse_m} m over {ranged}",
    "bias_m": "bias {bias_m}",
    "worst_m": "worst {worst_m}",
    "nees": "NEES {nees}",
    "over_half_metre": ">=0.5 m: {over_half_metre}",
}
"""Formats of the figures of a bar, as far as a score has them."""
