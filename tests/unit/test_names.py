"""Names say what a thing is or does, in the words of the field."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

AVOIDED = {
    *("told", "said", "says", "heard", "hear", "doubt", "doubts", "doubted", "looker", "sighting", "contest"),
    *("disown", "belief", "whereabouts", "learnt", "carried", "judged", "judgement", "casts", "swing"),
}
"""Words for which there is one of the field: reported, decoded, warning, aligned frame, estimated, ..."""

VERBS = {"feed", "shed"}
"""End as a participle does, and are none."""


def defined_names(tree: ast.Module) -> set[str]:
    """Every name that a module gives to something."""
    found = set()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                found.add(name)
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                found.add(name)
    return found


@pytest.mark.parametrize("package", ["evlcp_sdk", "plugins", "firmware_host"])
def test_names_use_the_words_of_the_field_and_functions_are_no_participles(package: str) -> None:
    paths = list((ROOT / package).rglob("*.py"))
    assert len(paths) > 20
    for path in paths:
        tree = ast.parse(path.read_text())
        for name in defined_names(tree):
            words = set(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_"))
            assert not words & AVOIDED, f"{path}: {name}"
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and not node.decorator_list:
                name = node.name.strip("_")
                assert name in VERBS or not re.fullmatch(r"[a-z]+ed", name), f"{path}: {name}, a participle"
