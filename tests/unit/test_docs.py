"""The docs hold: their code runs, their commands work, their links lead somewhere, nothing is left out."""

import re
import sys
import tomllib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk import hookspecs
from evlcp_sdk.abc import ROLES
from evlcp_sdk.config import resolve
from evlcp_sdk.messages.signing import make_key
from evlcp_sdk.registry import Registry

ROOT = Path(__file__).parents[2]
PAGES = (
    "index",
    "quickstart",
    "cli",
    "outputs",
    "messages",
    "configuration",
    "simulator",
    "campaigns",
    "compare",
    "paper",
    "rates",
    "roles",
    "hooks",
)
FILES = [ROOT / "README.md", *(ROOT / "docs" / f"{page}.md" for page in PAGES)]
HOOKS = [name for name in vars(hookspecs) if name.startswith("evlcp_")]


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, demo_raw: Path) -> Path:
    """A folder with what the examples name: REC.raw, its result, a link.toml."""
    (tmp_path / "REC.raw").symlink_to(demo_raw)
    (tmp_path / "link.toml").write_text("[camera]\nfocal_mm = 35.0\n")
    (tmp_path / "payload.bin").write_bytes(bytes(100))
    (site,) = [text for text in blocks(ROOT / "docs" / "messages.md", "text") if "[[bar]]" in text]
    (tmp_path / "site.toml").write_text(site)
    if find_spec("cryptography") is not None:
        make_key(tmp_path / "private.pem")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_code_and_commands_run(path: Path, workplace: Path, evlcp: Callable[..., Any]) -> None:
    if "OUT/" in path.read_text():
        assert evlcp("receive", "REC.raw", "-o", "OUT").code == 0
    names: dict[str, Any] = {"__name__": "example"}
    for code in blocks(path, "python"):
        if name := re.match(r"# (\w+)\.py\n", code):
            (workplace / f"{name[1]}.py").write_text(code)
        exec(compile(code, f"{path.name}", "exec"), names)
    for text in blocks(path, "console"):
        for line in text.splitlines():
            if " keygen " in line or " --key " in line:
                pytest.importorskip("cryptography", reason="the extra sign is not installed")
            if line.startswith("$ evlcp "):
                done = evlcp(*line.removeprefix("$ evlcp ").split())
                assert done.code == 0, f"{line}\n{done.err}"
    for name in ("line_plugin",):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_toml_examples_are_links(path: Path) -> None:
    for text in blocks(path, "toml"):
        table = tomllib.loads(text)
        if "project" not in table:
            resolve(table)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", path.read_text()):
        if not target.startswith("http"):
            name, _, anchor = target.partition("#")
            page = path.parent / name
            assert page.exists(), f"{path.name} links to {name}"
            if anchor:
                heads = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
                assert anchor in [h.lower().replace(" ", "-") for h in heads], (
                    f"{path.name} links to {target}"
                )


def test_the_message_that_is_shown_is_the_message(
    workplace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = ROOT / "docs" / "configuration.md"
    (code,) = [block for block in blocks(page, "python") if "source=" in block]
    exec(code, {})
    assert capsys.readouterr().out in blocks(page, "text")


@pytest.mark.parametrize("hook", HOOKS)
def test_every_hook_has_a_section_with_a_full_example(hook: str) -> None:
    page = (ROOT / "docs" / "hooks.md").read_text()
    section = page.split(f"\n## {hook}\n")[1].split("\n## ")[0]
    assert "@hookimpl" in section
    assert f"def {hook}(" in section


def test_every_stage_is_in_the_docs() -> None:
    page = (ROOT / "docs" / "hooks.md").read_text()
    doc = hookspecs.evlcp_stage_finished.__doc__ or ""
    stages = re.findall(r"`(\w+)`", doc.split("stage:")[1].split("value:")[0])
    assert len(stages) == 7
    for stage in stages:
        assert f"| `{stage}` |" in page


@pytest.mark.parametrize("role", ROLES)
def test_every_role_has_a_section_with_its_verbs_and_algorithms(role: str) -> None:
    page = (ROOT / "docs" / "roles.md").read_text()
    section = page.split(f"\n## {role}\n")[1].split("\n## ")[0]
    for verb in ROLES[role].__abstractmethods__:
        assert f"{ROLES[role].__name__}.{verb}(" in section
    for entry in Registry.load().installed(role):
        if entry.distribution == "evlcp-sdk":
            assert f"`{entry.algorithm.id}`" in section


def test_the_quickstart_is_the_example(capsys: pytest.CaptureFixture[str], workplace: Path) -> None:
    sys.modules.pop("quickstart", None)
    names: dict[str, Any] = {"__name__": "quickstart"}
    exec((ROOT / "examples" / "quickstart.py").read_text(), names)
    names["main"]("REC.raw")
    assert len(capsys.readouterr().out.splitlines()) > 10


def test_nothing_public_is_without_a_doc_page() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "index.md" or f"({page.name})" in index, f"docs/index.md leaves out {page.name}"
