"""`evlcp score`."""

from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli._common import Json, console

__all__ = ["register", "score"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("score")(score)


def score(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="What `evlcp receive -o OUT` wrote.")],
    truth_file: Annotated[Path, typer.Argument(metavar="REC.truth.json", help="The recording's truth.")],
    as_json: Json = False,
) -> None:
    """Hold a result against the truth: frames found, bit errors, distance errors.

    [bold]evlcp score out REC.truth.json[/]

    Each row of OUT/frames.csv is put beside the true frame that began nearest in time, on the bar nearest
    in the image.
    """
    import json

    from evlcp_sdk.study.score import read_frames, read_truth, score_frames

    found = score_frames(read_frames(folder), read_truth(truth_file)).to_dict()
    if as_json:
        typer.echo(json.dumps(found))
        return
    screen = console()
    screen.print(f"rows {found['rows']}, matching no true frame {found['unmatched']}")
    for i, bar in enumerate(found["bars"]):
        screen.print(
            f"bar {i}: frames {bar['frames_found']}/{bar['frames_sent']}  BER {bar['ber']}"
            f"  RMSE {bar['rmse_m']} m over {bar['ranged']}  >=0.5 m: {bar['over_half_metre']}"
        )
        for name, s in bar["segments"].items():
            screen.print(f"   {name}: RMSE {s['rmse_m']} m, bias {s['bias_m']} m, n {s['n']}")
