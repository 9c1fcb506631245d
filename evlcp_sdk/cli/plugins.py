"""`evlcp plugins`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from evlcp_sdk.cli._common import Json, echo, print_json

if TYPE_CHECKING:
    from evlcp_sdk.plugin.registry import InstalledAlgorithm, Registry


def plugins(as_json: Json = False) -> None:
    """List the roles, the algorithms installed, and broken plugins.

    `*` marks the default of a role, `!` two algorithms of one id, of which none can be used. Select an
    algorithm by its id: [bold]evlcp receive REC.raw -o out --set modulation.id=wh8[/]. Others' algorithms are
    imported, to see whether they can be.

    Exit code 0, also when plugins are broken and left out.
    """
    from evlcp_sdk.plugin.registry import Registry

    table = tabulate_plugins(Registry.load())
    if as_json:
        print_json(table, 2)
    else:
        echo(_format_table(table))


def tabulate_plugins(registry: Registry) -> dict[str, list[dict[str, Any]]]:
    """Roles, algorithms and broken plugins, as `--json` prints them."""
    from collections import Counter

    from evlcp_sdk.plugin.records import find_message_kinds, find_sinks
    from evlcp_sdk.plugin.roles import ROLES

    # This may find more broken plugins.
    find_sinks(registry)
    find_message_kinds(registry)
    entries = registry.list_algorithms()
    count = Counter((e.algorithm.role, e.algorithm.id) for e in entries)
    return {
        "roles": [{"role": r.name, "verb": r.verb, "default": r.default} for r in ROLES.values()],
        "algorithms": [
            {
                **{key: getattr(e.algorithm, key) for key in ("role", "id", "revision", "summary")},
                "distribution": e.distribution,
                "version": e.version,
                "default": ROLES[e.algorithm.role].default == e.algorithm.id,
                "conflict": count[e.algorithm.role, e.algorithm.id] > 1,
                "fault": _find_fault(e),
            }
            for e in entries
        ],
        "broken": [
            {"plugin": b.plugin, "distribution": b.distribution, "reason": b.reason} for b in registry.broken
        ],
    }


def _find_fault(installed: InstalledAlgorithm) -> str | None:
    """Why another package's algorithm cannot be used; None for one that can."""
    from evlcp_sdk.errors import PluginError
    from evlcp_sdk.plugin.registry import load_class

    try:
        if installed.distribution != "evlcp-sdk":
            load_class(installed)
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
