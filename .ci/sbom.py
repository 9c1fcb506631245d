"""The SBOM (CycloneDX 1.6) of what `make test` runs with, from the lock and pyproject.toml: `make sbom`.

Without a time and a serial number, so that the same lock gives the same bytes. The hashes of the files stay
in the lock. Licences are those that packages state which are installed here in the version of the lock.
"""

import json
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def locked(text: str) -> list[tuple[str, str, str]]:
    """(name, version, marker) of each package of a lock."""
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("#")).replace("\\\n", " ")
    found = []
    for line in lines.splitlines():
        what, _, marker = line.partition(" --hash=")[0].partition(";")
        name, _, version = what.partition("==")
        found.append((re.sub(r"[-_.]+", "-", name.strip()).lower(), version.strip(), marker.strip()))
    return found


def licences(name: str, version: str) -> list[dict[str, Any]]:
    """What an installed package says of its licence: an SPDX expression, or else names."""
    try:
        stated = metadata(name)
    except PackageNotFoundError:
        return []
    if stated["Version"] != version:
        return []
    if expression := stated["License-Expression"]:
        return [{"expression": expression}]
    names = [
        line.rpartition(" :: ")[2]
        for line in stated.get_all("Classifier", [])
        if line.startswith("License ::")
    ]
    said = (stated["License"] or "").strip()
    if not names and said:
        names = [said.splitlines()[0][:80]]
    return [{"license": {"name": one}} for one in names]


def sbom(lock: str, project: dict[str, Any]) -> dict[str, Any]:
    """The bill of materials as a table."""
    components = []
    for name, version, marker in locked(lock):
        purl = f"pkg:pypi/{name}@{version}"
        one: dict[str, Any] = {
            "type": "library",
            "bom-ref": purl,
            "name": name,
            "version": version,
            "purl": purl,
        }
        if found := licences(name, version):
            one["licenses"] = found
        if marker:
            one["properties"] = [{"name": "python:marker", "value": marker}]
        components.append(one)
    own = {"type": "library", "bom-ref": "root", "name": project["name"], "version": project["version"]}
    own["licenses"] = [{"license": {"id": project["license"]}}]
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": own},
        "components": components,
    }


def main() -> None:
    """Print it as JSON."""
    lock = (ROOT / "requirements-dev.lock").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    sys.stdout.write(json.dumps(sbom(lock, project), indent=1) + "\n")


if __name__ == "__main__":
    main()
