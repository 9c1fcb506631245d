"""`evlcp plugins`."""

from __future__ import annotations

from collections import Counter
from typing import Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, print_result
from evlcp_sdk.errors import PluginError


def plugins(ctx: typer.Context, as_json: Json = False) -> None:
    """List the roles, the algorithms installed, and broken plugins.

    `*` marks the default of a role, `!` two algorithms of one id, of which none can be used. Select an
    algorithm by its id: [bold]evlcp receive REC.raw -o out --set modulation.id=wh8[/]. Others' algorithms are
    imported, to see whether they can be.

    Exit code 0, also when plugins are broken and left out.
    """
    # The registry of the command line knows whose commands are broken; this may find more.
    registry: sdk.registry.Registry = ctx.obj
    sdk.records.find_sinks(registry)
    sdk.records.find_message_kinds(registry)
    entries = registry.list_algorithms()
    count = Counter((e.algorithm.role, e.algorithm.id) for e in entries)
    table: dict[str, list[dict[str, Any]]] = {
        "roles": [{"role": r.name, "verb": r.verb, "default": r.default} for r in sdk.roles.ROLES.values()],
        "algorithms": [
            {
                **{key: getattr(e.algorithm, key) for key in ("role", "id", "revision", "summary")},
                "distribution": e.distribution,
                "version": e.version,
                "default": sdk.roles.ROLES[e.algorithm.role].default == e.algorithm.id,
                "conflict": count[e.algorithm.role, e.algorithm.id] > 1,
                "fault": _find_fault(e),
            }
            for e in entries
        ],
        "broken": [
            {"plugin": b.plugin, "distribution": b.distribution, "reason": b.reason} for b in registry.broken
        ],
    }
    print_result(_format_table(table), table, as_json, 2)


def _find_fault(installed: sdk.registry.InstalledAlgorithm) -> str | None:
    """Why another package's algorithm cannot be used; None for one that can."""
    try:
        if installed.distribution != "evlcp-sdk":
            sdk.registry.load_class(installed)
    except PluginError as fault:
        return str(fault)
    return None


def _format_table(table: dict[str, list[dict[str, Any]]]) -> str:
    keys = ("id", "distribution", "version", "summary")
    widths = [max((len(str(a[k])) for a in table["algorithms"]), default=0) for k in keys]
    lines = []
    for role in table["roles"]:
        lines.append(f"{role['role']}: {role['verb']}")
        for a in table["algorithms"]:
            if a["role"] == role["role"]:
                mark = "!" if a["conflict"] else "*" if a["default"] else " "
                cells = (f"{a[k]!s:<{w}}" for k, w in zip(keys, widths, strict=True))
                lines.append(f"{mark} {'  '.join(cells)}".rstrip())
    lines += [f"broken: {a['fault']}" for a in table["algorithms"] if a["fault"] is not None]
    for b in table["broken"]:
        owner = f" of {b['distribution']}" if b["distribution"] else ""
        lines.append(f"broken: plugin {b['plugin']}{owner}: {b['reason']}")
    return "\n".join(lines)
