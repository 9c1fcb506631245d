"""Which bar of a file of sites sends a beacon."""

from pathlib import Path

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.sites import BarSite, load_sites


def site_that_sends(path: Path, transmitter_id: int | None, by: str) -> BarSite:
    """The bar of a file of sites that sends.

    Args:
        path: The file.
        transmitter_id: Its transmitter id; None for the only one.
        by: What chooses one, for messages.

    Raises:
        ConfigError: The file is wrong, or it is not clear which bar is meant.
    """
    sites = load_sites(path)
    ids = ", ".join(str(s.transmitter_id) for s in sites)
    if transmitter_id is None and len(sites) > 1:
        raise ConfigError(f"{path}: {len(sites)} bars: choose one with {by}, of {ids}")
    chosen = [s for s in sites if transmitter_id in (None, s.transmitter_id)]
    if not chosen:
        raise ConfigError(f"{path}: no bar has transmitter_id {transmitter_id}, but {ids}")
    return chosen[0]
