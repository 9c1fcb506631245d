"""Recordings with their truth beside them, received with every variant: one comparison of all."""

from collections.abc import Callable, Mapping, Sequence

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.io import EventSource, open_source
from evlcp_sdk.io.sensor import check_sensor
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.sim.truth import read_truth, truth_path
from evlcp_sdk.study.compare.run import measure_recording
from evlcp_sdk.study.compare.table import Comparison, Table, total_of
from evlcp_sdk.study.compare.variants import Variant

__all__ = ["compare_recording", "comparison_of"]


def compare_recording(
    url: str,
    variants: Sequence[Variant],
    registry: Registry | None = None,
    advance: Callable[[int, int | None], None] = lambda _done, _of: None,
) -> Table:
    """Receive a recording with every variant, and score it where its truth lies beside it.

    Args:
        url: The recording, plugins asked first.
        variants: At least one.
        registry: The plugins; None for all that are installed.
        advance: Called after every piece with the bytes that are done, and of how many if that is known.

    Raises:
        ConfigError: Its sensor, or the link it was sent with, is not that of a variant.
        InputError: The recording or its truth cannot be read.
    """
    registry = Registry.load() if registry is None else registry

    def opened() -> EventSource:
        source = open_source(url, registry)
        try:
            for link in (link for variant in variants for link in variant.links.values()):
                check_sensor(source, url, link.camera)
        except ConfigError:
            source.close()
            raise
        return source

    path = truth_path(url)
    truth = read_truth(path, registry) if path.exists() else None
    return measure_recording(url, opened, variants, truth, lambda s: advance(s.position_bytes, s.size_bytes))


def comparison_of(
    tables: Sequence[Table], variants: Sequence[Variant], versions: Mapping[str, str]
) -> Comparison:
    """The tables of recordings, with one of them all behind where there are several.

    Args:
        tables: Of `compare_recording`, in the order in which they are shown.
        variants: Those that they compare.
        versions: Of the packages that took part.
    """
    notes = []
    for table in tables:
        beside = truth_path(table.name)
        if not beside.exists():
            notes.append(f"{table.name}: no {beside.name} beside it, so no BER and no distance error")
    for i, variant in enumerate(variants):
        counted = [one.rows[i].measured.statistics for one in tables]
        if ghosts := sum(one.unmatched for one in counted):
            notes.append(f"{variant.name}: {ghosts} frame{'s' * (ghosts != 1)} without a true one")
        if echoes := sum(one.echoes for one in counted):
            notes.append(f"{variant.name}: {echoes} frame{'s' * (echoes != 1)} of reflections, left out")
    all_of = (total_of(tables),) if len(tables) > 1 else ()
    about = {v.name: v.to_dict() for v in variants}
    return Comparison(about, (*tables, *all_of), tuple(notes), dict(versions))
