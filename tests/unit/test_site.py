"""The documentation site: it is built without a warning, asks no other server, and can be searched."""

import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import evlcp_sdk
from tests.unit.study.browser import CHROMIUM, Browser

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("sphinx", "furo", "myst_parser")),
    reason="the extra docs is not installed",
)


def build(out: Path) -> None:
    """The site, every page written; what was read for an earlier one is taken from .sphinx/test/.

    Without what takes half of the time, and of which nothing here depends: contents that list the members of
    every class, types in signatures, and defaults spelt as in the source.
    """
    read = ROOT / ".sphinx" / "test"
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", read, ROOT / "docs", out]
    for setting in ("toc_object_entries=0", "autodoc_typehints=none", "autodoc_preserve_defaults=0"):
        command += ["-D", setting]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        shutil.rmtree(read, ignore_errors=True)  # or else what it warns of is not read again
    assert (done.returncode, done.stderr) == (0, "")


def test_the_reference_has_every_name_of_the_face_once() -> None:
    named = [
        name
        for page in sorted((ROOT / "docs" / "api").glob("*.md"))
        for line in re.findall(r"^\{names\} (.+)$", page.read_text(), re.MULTILINE)
        for name in line.split()
    ]
    differ = sorted(set(named) ^ set(evlcp_sdk.__all__))
    assert not differ, (
        f"{', '.join(differ)}: in a line {{names}} of docs/api/*.md, or in the face, not in both"
    )
    assert len(set(named)) == len(named)


def test_the_site_is_whole_and_asks_no_other_server(tmp_path: Path) -> None:
    site = tmp_path / "site"
    build(site)
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(r"<(?:script|img|iframe|source)\b[^>]*?\bsrc=\"([^\"]*)\"", text)
        fetched += re.findall(
            r"<link\b(?![^>]*rel=\"(?:canonical|author|search)\")[^>]*?href=\"([^\"]*)\"", text
        )
        for name in fetched:
            if name.startswith("data:"):
                continue
            path = name.partition("?")[0].partition("#")[0]
            assert (page.parent / path).exists(), f"{page.name} asks for {name}"
    if CHROMIUM is None:
        pytest.skip("needs Chromium (Debian: apt-get install chromium)")
    with Browser(tmp_path / "profile") as browser:
        for width, dark in ((1280, False), (390, True)):
            browser.dress(width, dark=dark)
            browser.open(site / "index.html")
            assert browser.fits()
            shown = "getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0] < 128"
            assert browser.value(shown) is dark
            assert len(browser.requests) > 5
            assert all(url.startswith(("file:", "data:")) for url in browser.requests)
        browser.open((site / "search.html").as_uri() + "?q=tilt")
        links = "[...document.querySelectorAll('#search-results li a')].map(a => a.href)"
        browser.until(f"{links}.length > 2")
        assert any("receiver.html" in link for link in browser.value(links))


def test_every_fault_that_code_raises_is_in_the_index_of_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """By another way than the index itself: the words of a raise statement, line by line."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from error_index import EXIT_CODES, as_markdown, messages

    found = messages()
    page = as_markdown(found)
    kinds = "|".join(EXIT_CODES)
    missed, seen = [], 0
    for path in sorted((ROOT / "evlcp_sdk").rglob("*.py")):
        for text in re.findall(
            rf"raise (?:{kinds})\(\s*f?\"([^\"{{}}`|]{{12,}})\"", path.read_text(encoding="utf-8")
        ):
            seen += 1
            if " ".join(text.split()) not in page:
                missed.append(f"{path.name}: {text}")
    assert seen > 20
    assert not missed
    assert len(found) > 400
    assert sum(bool(one.cause) for one in found) > len(found) / 2
    listed = (ROOT / "docs" / "errors.md").read_text().split("## The ones seen most")[1]
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "evlcp_sdk").rglob("*.py"))
    sources += "".join(path.read_text(encoding="utf-8") for path in (ROOT / "firmware_host").rglob("*.py"))
    for words in re.findall(r"^\| `([^`]+)` \|", listed, re.MULTILINE):
        assert words in sources, words
