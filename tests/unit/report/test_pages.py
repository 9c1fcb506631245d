"""Pages: what enters them as text stays text, and no script runs but those that they were written with."""

import base64
import hashlib
import re
from html.parser import HTMLParser

import pytest

from evlcp_sdk.report.pages import render_page

HOSTILE = (
    "</script><script>document.title='caught'</script><img src=x onerror=\"document.title='caught'\">'\"&"
)


class Elements(HTMLParser):
    """What a page consists of, as a browser reads it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.text = ""
        self._in = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._in = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        self._in = ""

    def handle_data(self, data: str) -> None:
        if self._in == "script":
            self.scripts[-1] += data
        elif self._in != "style":
            self.text += data

    @property
    def policy(self) -> dict[str, list[str]]:
        (content,) = (
            a["content"] or "" for _, a in self.tags if a.get("http-equiv") == "Content-Security-Policy"
        )
        return {part.split()[0]: part.split()[1:] for part in content.split(";")}


def hash_of(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def test_only_the_scripts_of_a_page_may_run() -> None:
    scripts = ["one()", "two('\r\n')"]
    page = Elements(render_page("base.html", "a", scripts, {"held": 1}))
    assert page.policy["script-src"] == [hash_of(s) for s in page.scripts[1:]]
    assert page.policy["script-src"] == [hash_of("one()"), hash_of("two('\n')")]
    assert page.policy["default-src"] == page.policy["base-uri"] == page.policy["form-action"] == ["'none'"]
    text = render_page("base.html", "a")
    assert Elements(text).policy["script-src"] == ["'none'"]
    head = text.partition("<title>")[0]
    # What stands before the policy is not bound by it.
    assert not re.search("<(script|style|link)", head.partition("Content-Security-Policy")[0])


def test_a_script_that_ends_its_element_is_refused() -> None:
    with pytest.raises(ValueError, match="would end its own element"):
        render_page("base.html", "a", ["x = '</SCRIPT>'"])
