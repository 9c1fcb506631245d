"""The docs hold: their code runs, their commands work, their links lead somewhere, nothing is left out."""

import importlib
import inspect
import pkgutil
import re
import shlex
import sys
import tomllib
from collections.abc import Callable
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any
from xml.etree.ElementTree import fromstring

import pytest

import evlcp_sdk
from evlcp_sdk.air.signing import make_key
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.plugin import hooks as hookspecs
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.sim.scene import resolve_scene
from evlcp_sdk.testing import check

ROOT = Path(__file__).parents[2]
NOT_RUN = {
    *("changelog", "contributing", "diagnose", "hardware", "protocol", "security", "transmitter"),
    *("third-party-formats", "third-party-plugin"),
}
"""Pages of docs/ whose commands need a board, or that are files of the repository."""
ALL = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FILES = [path for path in ALL if path.parent == ROOT or path.stem not in NOT_RUN]
HOOKS = [name for name in vars(hookspecs) if name.startswith("evlcp_")]


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(), re.MULTILINE | re.DOTALL)


RUNS_ON = {line: page for page in FILES for text in blocks(page, "console") for line in text.splitlines()}
"""The page with which a command is run that stands on several: the last, whose next commands may need it."""


def section_of(page: str, head: str) -> str:
    """The text under a heading of the second level."""
    return (ROOT / "docs" / f"{page}.md").read_text().split(f"\n## {head}\n")[1].split("\n## ")[0]


def needs_compiler() -> None:
    """Skip without what builds the board's firmware for this machine."""
    if which("cc") is None or which("make") is None:
        pytest.skip("cc or make is missing")


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, demo_raw: Path) -> Path:
    """A folder with what the examples name: REC.raw, its result, a link.toml."""
    (tmp_path / "REC.raw").symlink_to(demo_raw)
    (tmp_path / "link.toml").write_text("[camera]\nfocal_mm = 35.0\n")
    (tmp_path / "payload.bin").write_bytes(bytes(100))
    (site,) = [text for text in blocks(ROOT / "docs" / "position.md", "text") if "[[bar]]" in text]
    (tmp_path / "site.toml").write_text(site)
    (tmp_path / "imu.csv").write_text("t_us,pitch_deg,roll_deg,heading_deg\n0,0,0,0\n1000000,0,0,0\n")
    (tmp_path / "gnss.csv").write_text(
        "t_us,latitude_deg,longitude_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m\n"
        "50000,35,137,50,1,1,2\n"
    )
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
    modules = set(sys.modules)
    for code in blocks(path, "python"):
        if "light_of" in code:
            continue  # the lines of an example that is run below
        if ".to_arrow(" in code:
            pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
        if name := re.match(r"# (\w+)\.py\n", code):
            (workplace / f"{name[1]}.py").write_text(code)
        exec(compile(code, f"{path.name}", "exec"), names)
    for text in blocks(path, "console"):
        for line in text.splitlines():
            if " loop " in line:
                needs_compiler()
            if " keygen " in line or " --key " in line:
                pytest.importorskip("cryptography", reason="the extra sign is not installed")
            if line.startswith("$ evlcp ") and RUNS_ON[line] == path:
                done = evlcp(*shlex.split(line.removeprefix("$ evlcp ")))
                assert done.code == 0, f"{line}\n{done.err}"
    for name in set(sys.modules) - modules:
        if getattr(sys.modules[name], "__file__", None) == str(workplace / f"{name}.py"):
            sys.modules.pop(name)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_toml_examples_are_links_or_scenes(path: Path, tmp_path: Path) -> None:
    for name in ("link.toml", "other.toml"):
        (tmp_path / name).touch()
    for text in blocks(path, "toml"):
        table = tomllib.loads(text)
        if "bars" in table:
            resolve_scene(table, folder=tmp_path)
        elif "project" not in table:
            resolve(table)


def test_links_of_the_examples_are_links() -> None:
    for path in (ROOT / "examples" / "link.toml", *(ROOT / "examples" / "links").glob("*.toml")):
        load_link(path)


@pytest.mark.parametrize("path", ALL, ids=lambda p: p.stem)
def test_links_files_and_modules_that_a_page_names_exist(path: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", path.read_text()):
        if not target.startswith("http"):
            name, _, anchor = target.partition("#")
            page = path.parent / name if name else path
            assert page.exists(), f"{path.name} links to {name}"
            if anchor:
                heads = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
                assert anchor in [h.lower().replace(" ", "-") for h in heads], (
                    f"{path.name} links to {target}"
                )
    rooms = "evlcp_sdk|firmware_host|plugins|examples|tests|benchmarks|docs"
    named = set(re.findall(rf"(?<![\w/.])(?:{rooms})/[\w./-]*[\w/](?!\w)", path.read_text()))
    assert not [name for name in named if "NAME" not in name and not (ROOT / name).exists()]
    for name in set(re.findall(r"\b(?:evlcp_\w+|firmware_host)(?:\.\w+)+", path.read_text())):
        pkgutil.resolve_name(name)


def test_the_message_that_is_shown_is_the_message(workplace, capsys) -> None:
    page = ROOT / "docs" / "configuration.md"
    (code,) = [block for block in blocks(page, "python") if "source=" in block]
    exec(code, {})
    assert capsys.readouterr().out in blocks(page, "text")


@pytest.mark.parametrize("hook", HOOKS)
def test_every_hook_has_a_section_with_a_full_example(hook: str) -> None:
    section, called = section_of("hooks", hook), f"{hook}{inspect.signature(getattr(hookspecs, hook))}"
    assert "`" + called.replace("'", "") + "`" in section.replace("typing.", "")
    for text in ("\nCalled ", "@evlcp.hookimpl", f"def {hook}("):
        assert text in section


def test_every_stage_is_in_the_docs() -> None:
    page = (ROOT / "docs" / "hooks.md").read_text()
    doc = hookspecs.evlcp_stage_finished.__doc__ or ""
    stages = re.findall(r"`(\w+)`", doc.split("stage:")[1].split("value:")[0])
    assert len(stages) == 9
    for stage in stages:
        assert f"| `{stage}` |" in page


@pytest.mark.parametrize("role", ROLES)
def test_every_role_has_a_section_with_its_verbs_and_algorithms(role: str) -> None:
    section = section_of("roles", role)
    abstract = ROLES[role].abstract
    for verb in abstract.__abstractmethods__:
        assert f"{abstract.__name__}.{verb}(" in section
    for entry in Registry.load().list_algorithms(role):
        if entry.distribution == "evlcp-sdk":
            assert f"`{entry.algorithm.id}`" in section
            if fields(Registry.load().load_class(role, entry.algorithm.id)):
                assert f"\n{{parameters}} {role}\n" in section


@pytest.mark.parametrize("role", ROLES)
def test_the_examples_of_every_role_keep_its_laws(role: str, workplace: Path) -> None:
    codes = re.findall(r"^```python\n(.*?)^```$", section_of("roles", role), re.MULTILINE | re.DOTALL)
    assert codes
    for code in codes:
        first = re.match(r"# (\w+)\.py\n", code)
        assert first
        (workplace / f"{first[1]}.py").write_text(code)
        try:
            module = importlib.import_module(first[1])
            classes = [found for found in vars(module).values() if isinstance(found, type)]
            (cls,) = [
                found
                for found in classes
                if issubclass(found, ROLES[role].abstract) and found.__module__ == first[1]
            ]
            for outcome in check(role, cls()):
                assert outcome.status == "ok", f"{outcome.law.name}: {outcome.detail}"
        finally:
            sys.modules.pop(first[1], None)


def test_the_quickstart_is_the_example(capsys: pytest.CaptureFixture[str], workplace: Path) -> None:
    needs_compiler()
    sys.modules.pop("quickstart", None)
    names: dict[str, Any] = {"__name__": "quickstart"}
    exec((ROOT / "examples" / "quickstart.py").read_text(), names)
    names["main"]("Road works", workplace / "out")
    captured = capsys.readouterr().out.splitlines()
    assert "read: Road works" in captured
    assert len(captured) > 30
    code = next(text for text in blocks(ROOT / "docs" / "quickstart.md", "python") if "light_of" in text)
    lines = [line.strip() for line in (ROOT / "examples" / "quickstart.py").read_text().splitlines()]
    reported = [line.strip().replace('text="Road works"', "text=text") for line in code.splitlines()]
    assert set(reported) - set(lines) == {'folder = Path("quickstart-out")'}


def test_what_users_read_first_uses_the_public_face_only() -> None:
    paths = [ROOT / name for name in ("README.md", "docs/quickstart.md")]
    paths += [path for path in (ROOT / "examples").rglob("*.py") if "tests" not in path.parts]
    assert len(paths) > 9
    for path in paths:
        found = set(re.findall(r"^ *(?:import|from) +evlcp_sdk\b.*$", path.read_text(), re.MULTILINE))
        assert found <= {"import evlcp_sdk as evlcp"}, path


def test_the_drawing_of_the_link_is_what_its_program_draws() -> None:
    from docs.figures.link import TEXT, drawing

    assert (ROOT / "docs" / "images" / "link.svg").read_text(encoding="utf-8") == drawing()
    assert drawing().count(f">{TEXT}</text>") == 2
    fromstring(drawing())


def test_every_name_of_the_face_that_a_page_shows_exists() -> None:
    for path in [*FILES, *(ROOT / "examples").glob("*.py")]:
        for name in re.findall(r"\bevlcp\.(\w+)", path.read_text()):
            assert name in evlcp_sdk.__all__, f"{path.name} names evlcp.{name}"


def test_the_tree_of_contributing_is_the_tree() -> None:
    text = next(text for text in blocks(ROOT / "CONTRIBUTING.md", "text") if "evlcp_sdk/errors.py" in text)
    reported = re.findall(r"^(\S+)  +\S", text, re.MULTILINE)
    assert len(reported) == len(text.splitlines())
    for path in reported:
        found = ROOT / path
        assert found.is_dir() if path.endswith("/") else found.is_file(), f"CONTRIBUTING.md: {path}"
    rooms = {
        f"evlcp_sdk/{path.name}{'/' * path.is_dir()}"
        for path in (ROOT / "evlcp_sdk").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert rooms == {path for path in reported if path.startswith("evlcp_sdk/")}
