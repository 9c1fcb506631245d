"""What `evlcp warm-up` compiles is what later commands need."""

import json

import pytest
from typer.testing import CliRunner

from evlcp_sdk.cli import _app
from evlcp_sdk.warming import STEPS, Warmth, warm_up


def test_a_warm_up_leaves_nothing_to_compile() -> None:
    """The first compiles what there is not; the second finds all of it."""
    steps: list[str] = []
    warmth = warm_up(steps.append)
    assert tuple(steps) == STEPS
    assert warmth.kept_in is not None
    assert warm_up().compiled == 0


@pytest.mark.parametrize(
    ("warmth", "words"),
    [
        (Warmth(0, 2.5, None), "nothing to compile; tried in 2.5 s"),
        (Warmth(7, 31.0, None), "7 kernels compiled in 31 s they cannot be kept"),
    ],
)
def test_the_command_says_what_it_did(monkeypatch: pytest.MonkeyPatch, warmth: Warmth, words: str) -> None:
    monkeypatch.setattr("evlcp_sdk.warming.warm_up", lambda advance: [advance(s) for s in STEPS] and warmth)
    runner, app = CliRunner(), _app.make_app()
    done = runner.invoke(app, ["warm-up"])
    assert done.exit_code == 0
    assert " ".join(done.stdout.split()).startswith(words)
    done = runner.invoke(app, ["warm-up", "--json"])
    assert json.loads(done.stdout) == {
        "compiled": warmth.compiled,
        "elapsed_s": warmth.elapsed_s,
        "kept_in": None,
    }
