"""The page that shows the paper beside ours says what its committed result says."""

import json
from typing import Any

import pytest

from evlcp_sdk.study.report import comparison_rows
from evlcp_sdk.study.summary import PAPER, Figure, PaperComparison, Reference, verdict_of
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "paper.md").read_text()
RESULT: dict[str, Any] = json.loads((ROOT / "docs" / "paper.json").read_text())
FIELDS = ("measure", "clusters", "speed_kmh", "from_m", "to_m", "value", "bound")


def comparison(table: dict[str, Any]) -> PaperComparison:
    reference = Reference(**{name: table[name] for name in FIELDS})
    return PaperComparison(
        reference, table["series"], Figure(**table["ours"]), *table["ours_at_m"], table["verdict"]
    )


@pytest.mark.parametrize(
    "table", RESULT["paper"], ids=lambda t: f"{t['measure']}-{t['from_m']}-{t['series']}"
)
def test_every_comparison_is_on_the_page(table: dict[str, Any]) -> None:
    (row,) = comparison_rows([comparison(table)])
    assert table["verdict"] == verdict_of(table["ours"]["value"], comparison(table).reference)
    assert f"| {' | '.join(row)} |" in PAGE


def test_the_result_is_whole_and_of_the_shipped_campaign() -> None:
    assert RESULT["done"] == RESULT["tasks"]
    assert {tuple(t[name] for name in FIELDS) for t in RESULT["paper"]} == {
        tuple(getattr(r, name) for name in FIELDS) for r in PAPER
    }
    assert [s["name"] for s in RESULT["series"]] == [
        f"{v} km/h, {method}" for v in (20, 30, 40) for method in ("16 clusters", "two clusters")
    ]


def test_the_guesses_bring_the_near_figures_within_30_percent() -> None:
    near = [
        t for t in RESULT["paper"] if t["measure"] == "rmse_m" and t["clusters"] == 16 and t["to_m"] <= 50
    ]
    assert [t["value"] for t in near] == [0.0702, 0.1216]
    assert all(t["verdict"] == "agrees" for t in near)
