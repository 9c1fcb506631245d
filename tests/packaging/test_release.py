"""What a release consists of agrees: version, citation, changelog."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_citation_and_project_state_the_same_version_and_licence() -> None:
    stated = dict(re.findall(r"^(version|license): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert stated == {"version": PROJECT["version"], "license": PROJECT["license"]}


def test_make_has_a_rule_for_each_target_that_it_names() -> None:
    text = (ROOT / "Makefile").read_text()
    named = {name for line in re.findall(r"^\.PHONY: (.+)$", text, re.MULTILINE) for name in line.split()}
    assert {"demo", "test", "docs", "release"} <= named
    assert named <= set(re.findall(r"^([a-z]+):", text, re.MULTILINE))


def test_the_changelog_begins_with_what_comes_next() -> None:
    heads = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert heads[0] in ("Unreleased", PROJECT["version"])
    assert PROJECT["version"] in heads[:2]
