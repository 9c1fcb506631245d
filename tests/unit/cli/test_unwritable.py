"""Outputs that cannot be written end every command in the same way, and links in their places stay."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk.study.collect import collect_results
from evlcp_sdk.study.jobs import Inline
from evlcp_sdk.study.store import Store
from tests.unit.study.fake import fake_plan, run_fake

Evlcp = Callable[..., Any]

CAMPAIGN = """
[campaign]
name = "a"
seeds = 1
[scene]
base = "night"
set = { duration_s = 0.02 }
"""

COMMANDS = {
    "receive": ("receive", "REC.raw", "-o", "OUT"),
    "receive many": ("receive", "REC.raw", "b.raw", "-o", "OUT"),
    "receive --figures": ("receive", "REC.raw", "-o", "OUT", "--figures"),
    "video": ("video", "REC.raw", "-o", "OUT.webp", "--for-ms", "0.1", "--size", "64"),
    "simulate": ("simulate", "--preset", "night", "-o", "OUT.raw", "--set", "duration_s=0.01"),
    "sweep": ("sweep", "campaign.toml", "-o", "OUT.sqlite", "--workers", "0"),
    "report": ("report", "results.sqlite", "-o", "OUT.html"),
    "report --figures": ("report", "results.sqlite", "--figures", "OUT"),
    "compare": ("compare", "REC.raw", "--variant", "a:", "-o", "OUT.csv"),
    "demo": ("demo", "-o", "OUT"),
    "demo --recording": ("demo", "--recording", "-o", "OUT"),
    "tx message": ("tx", "message", "--text", "a", "-o", "OUT.json"),
    "tx message --chips": ("tx", "message", "--text", "a", "--chips", "OUT.npy"),
    "tx frames": ("tx", "frames", "--random", "1", "--chips", "OUT.npy"),
    "tx keygen": ("tx", "keygen", "OUT.pem"),
    "board leds": ("board", "leds", "leds.bin", "--chips", "OUT.npy"),
}


@pytest.fixture
def workplace(tmp_path: Path, demo_raw: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("REC.raw", "b.raw"):
        (tmp_path / name).write_bytes(demo_raw.read_bytes())
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    (tmp_path / "leds.bin").write_bytes(bytes(20))
    with Store(tmp_path / "results.sqlite", create=True) as store:
        collect_results(fake_plan(1, 1, 1), store, Inline(), run_fake)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_what_cannot_be_written_ends_with_1(evlcp: Evlcp, workplace: Path, command: str) -> None:
    (workplace / "file").write_text("a file, no folder")
    before = sorted(workplace.iterdir())
    done = evlcp(*(a.replace("OUT", "file/OUT") for a in COMMANDS[command]))
    assert done.code == 1
    lines = done.err.splitlines()
    assert len(lines) == (2 if command == "receive many" else 1)
    assert all(line.startswith("evlcp: file/OUT") and ": cannot be written: " in line for line in lines)
    assert sorted(workplace.iterdir()) == before


IN_PLACE = {
    "receive": "OUT/frames.csv",
    "receive --figures": "OUT/regions.png",
    "demo --recording": "OUT/summary.json",
    "report --figures": "OUT/ber.svg",
}
"""What a folder holds; the other outputs are the files that are named."""


@pytest.mark.parametrize("command", [c for c in COMMANDS if c not in ("receive many", "demo", "tx keygen")])
def test_planted_links_are_not_followed(evlcp: Evlcp, workplace: Path, command: str) -> None:
    arguments = COMMANDS[command]
    link = Path(IN_PLACE.get(command) or next(a for a in arguments if a.startswith("OUT")))
    (workplace / link).parent.mkdir(exist_ok=True)
    (workplace / "victim").write_text("mine")
    (workplace / link).symlink_to(workplace / "victim")
    before = sorted(workplace.rglob("*"))
    done = evlcp(*arguments)
    assert done.code == 1
    assert "written: " not in done.out
    assert (
        done.err
        == f"evlcp: {link}: cannot be written: it is a link; name the file itself, or remove the link\n"
    )
    assert (workplace / link).is_symlink()
    assert (workplace / "victim").read_text() == "mine"
    folder = workplace / "OUT-figures"
    assert [p for p in sorted(workplace.rglob("*")) if p != folder] == before
