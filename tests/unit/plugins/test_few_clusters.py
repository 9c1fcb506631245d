"""Rangings on bars of few clusters: what one refuses, another takes where its message says so."""

import re

import numpy as np
import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.testing import ideal_view

PANEL = ("bar.rows=16", "bar.columns=16", "bar.cluster_rows=4", "bar.cluster_columns=4")
LAYOUTS = {
    **{f"{n} clusters": (f"bar.rows={6 * n}",) for n in (1, 2, 3, 4, 5, 6, 7, 16)},
    "4x4 panel": PANEL,
    "two columns": ("bar.rows=96", "bar.columns=2", "bar.cluster_rows=12"),
    "one row of two": ("bar.rows=1", "bar.columns=2", "bar.cluster_rows=1"),
    "ring": ("bar.shape=ring",),
    "apart": ("bar.shape=columns",),
    "not alike": (
        "bar.shape=table",
        "bar.leds=[[0, 0, 0, 0], [0, 0.1, 0, 0], [0.3, 0, 0, 1], [0, 0.4, 0, 2], [1, 1, 0, 3]]",
    ),
    "two lamps": ("bar.shape=table", "bar.leds=[[0, 0, 0, 0], [0.3, 0, 0, 1]]"),
    "three LEDs": ("bar.shape=table", "bar.leds=[[0, 0, 0, 0], [0.3, 0, 0, 1], [0, 0.2, 0, 2]]"),
}
RANGINGS = [entry.algorithm.id for entry in Registry.load().list_algorithms("ranging")]


def link_with(layout, *overrides):
    return load_link(overrides=[*LAYOUTS[layout], *overrides])


def compile_link(link):
    return link.algorithm("ranging").compile(link.camera, link.bar, link.codebook)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_link_that_names_no_ranging_measures_its_bar(layout):
    link = link_with(layout)
    # Of two clusters beside one another, each has light on its other side: both look further out.
    beside = {"1 clusters": "none", "2 clusters": "none", "one row of two": "none", "not alike": "centroid"}
    wanted = beside.get(layout, "poc" if layout in ("ring", "three LEDs", "two lamps") else "joint-scale")
    assert link.table["ranging"]["id"] == wanted
    compile_link(link)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", RANGINGS)
def test_what_is_accepted_measures_and_what_is_recommended_is_accepted(name, layout):
    link = link_with(layout, f"ranging.id={name}")
    try:
        measure = compile_link(link)
    except ConfigError as refused:
        reported = str(refused)
        settings = [
            f"ranging.{key}={value}" for key, value in re.findall(r"ranging\.(\w+) = (\d+)$", reported)
        ]
        other = re.search(r"use '([\w-]+)' for this layout", reported)
        assert settings or other
        compile_link(link_with(layout, *settings, f"ranging.id={other[1] if other else name}"))
        return
    if np.ptp(link.bar.cluster_centres_m()[:, 0]) > 0:
        return
    # What accepts a bar measures it: 8 px from cluster to cluster.
    found = measure(ideal_view(link.codebook, np.arange(link.bar.clusters) % len(link.codebook.codewords)))
    if name == "none":
        assert np.isnan([found.distance_m, found.sigma_m]).all()
    else:
        assert found.distance_m == pytest.approx(link.camera.distance_m(0.06, 8), rel=1e-3)


def test_joint_scale_refuses_pilots_of_other_codes():
    link = link_with(
        "16 clusters", "modulation.id=wh4x2-dimmed", "pilots.id=wh-dimmed", "ranging.id=joint-scale"
    )
    with pytest.raises(ConfigError, match=r"the pilots are others; try ranging\.id = 'poc'"):
        compile_link(link)
