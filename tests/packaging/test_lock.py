"""The lock of development holds what `pyproject.toml` asks for, and what a release consists of agrees."""

import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
LOCK = (ROOT / "requirements-dev.lock").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
VERSION = PROJECT["project"]["version"]
ASKED = [
    *PROJECT["build-system"]["requires"],
    *PROJECT["project"]["dependencies"],
    *(one for extra in PROJECT["project"]["optional-dependencies"].values() for one in extra),
    *(one for group in PROJECT["dependency-groups"].values() for one in group),
]


def entries():
    """One text a package: `name==version ; marker --hash=...`."""
    lines = "\n".join(line for line in LOCK.splitlines() if not line.startswith("#"))
    return lines.replace("\\\n", " ").splitlines()


def requirement(entry):
    return Requirement(entry.partition(" --hash=")[0])


def packages():
    """Name and version of each."""
    found = map(requirement, entries())
    return {(canonicalize_name(one.name), str(one.specifier).removeprefix("==")) for one in found}


@pytest.mark.parametrize("asked", ASKED)
def test_what_the_project_asks_for_is_locked(asked):
    wanted = Requirement(asked)
    versions = [version for name, version in packages() if name == canonicalize_name(wanted.name)]
    assert versions, f"requirements-dev.lock lacks {wanted.name}"
    assert all(wanted.specifier.contains(version) for version in versions), (asked, versions)


def test_every_package_is_pinned_by_version_and_hash():
    for entry in entries():
        (one,) = requirement(entry).specifier
        assert one.operator == "==", entry
        assert not one.version.endswith("*"), entry
        hashes = entry.partition(" --hash=")[2].split("--hash=")
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", h.strip()) for h in hashes), entry


def test_the_lock_names_no_registry_and_no_machine():
    assert not re.search(r"://|index-url|find-links|^\s*-[a-z]|/[a-z]+/", LOCK)


def test_the_sbom_names_every_package_of_the_lock():
    """`make sbom`, by its output: the lock's packages, no more and no less, the same each time."""
    command = [sys.executable, ROOT / ".ci" / "sbom.py"]
    reported = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)]
    assert reported[0] == reported[1]
    table = json.loads(reported[0])
    assert (table["bomFormat"], table["specVersion"]) == ("CycloneDX", "1.6")
    assert table["metadata"]["component"]["name"] == PROJECT["project"]["name"]
    assert {(one["name"], one["version"]) for one in table["components"]} == packages()
    assert all(one["purl"] == f"pkg:pypi/{one['name']}@{one['version']}" for one in table["components"])
    refs = [one["bom-ref"] for one in table["components"]]
    assert len(set(refs)) == len(refs) > 50
    # `make test` takes the newest versions: a licence is that of the one in the lock, or not told.
    licensed = {one["name"] for one in table["components"] if "licenses" in one}
    here = {canonicalize_name(one.metadata["Name"]): one.version for one in distributions()}
    alike = {name for name, version in packages() if here.get(name) == version}
    assert licensed <= alike
    assert licensed >= alike & {"numpy", "scipy", "pydantic", "hatchling"} != set()
    assert "sbom:" in (ROOT / "Makefile").read_text()


def test_citation_and_project_state_the_same_version_and_licence():
    stated = dict(re.findall(r"^(version|license): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert stated == {"version": VERSION, "license": PROJECT["project"]["license"]}


def test_make_has_a_rule_for_each_target_that_it_names():
    text = (ROOT / "Makefile").read_text()
    named = {name for line in re.findall(r"^\.PHONY: (.+)$", text, re.MULTILINE) for name in line.split()}
    assert {"demo", "test", "docs", "release"} <= named
    assert named <= set(re.findall(r"^([a-z]+):", text, re.MULTILINE))


def test_the_changelog_begins_with_what_comes_next():
    heads = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert heads[0] in ("Unreleased", VERSION)
    assert VERSION in heads[:2]
