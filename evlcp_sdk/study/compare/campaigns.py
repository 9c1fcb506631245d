"""The links of a campaign as variants."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from evlcp_sdk.study.campaign.summary import Series, Summary
from evlcp_sdk.study.compare.measured import Measured
from evlcp_sdk.study.compare.table import Comparison, Row, Table, total_of

__all__ = ["of_campaign"]


def of_campaign(summary: Summary) -> Comparison:
    """The links of a campaign as variants, with a table per scene.

    Time, which a campaign does not keep, has no column; nor is there a bound, which needs the events.
    """
    links: dict[str, Mapping[str, Any]] = {}
    scenes: dict[str, list[Row]] = {}
    for series in summary.series:
        scene, link = _part(series, "scene.", "the scene"), _part(series, "link.", "the link")
        settings = [
            f"{k.removeprefix('link.')}={v}" for k, v in series.labels.items() if k.startswith("link.")
        ]
        identity = series.link if isinstance(series.link, Mapping) else {}
        links[link] = {
            "settings": settings,
            "digest": identity.get("digest", ""),
            "configuration": identity.get("table", {}),
        }
        scenes.setdefault(scene, []).append(Row(link, _measured(series)))
    tables = [Table(name, tuple(rows)) for name, rows in scenes.items()]
    notes = [f"campaign {summary.name}, {summary.digest}"]
    if len({tuple(row.variant for row in table.rows) for table in tables}) > 1:
        notes.append("not every link receives every scene, so that there is no table of all scenes")
    elif len(tables) > 1:
        tables.append(total_of(tables, "all scenes"))
    if summary.done < summary.tasks:
        notes.append(f"{summary.done} of {summary.tasks} tasks are done")
    return Comparison(links, tuple(tables), tuple(notes), summary.plan.environment, "scene")


def _measured(series: Series) -> Measured:
    recordings = {f"seed {i}": one.total() for i, one in enumerate(series.recordings)}
    return Measured(series.statistics, recordings=recordings)


def _part(series: Series, prefix: str, otherwise: str) -> str:
    """The name that a series has by the labels of its scene or of its link."""
    labels = {key: value for key, value in series.labels.items() if key.startswith(prefix)}
    return replace(series, labels=labels).name if labels else otherwise
