"""The SDK's modules for commands, each imported at its first use: help and refusals come at once."""

# ruff: noqa: F401
# mypy: implicit-reexport

from typing import TYPE_CHECKING

from evlcp_sdk.lazy import find_module

if TYPE_CHECKING:
    from evlcp_sdk import files, kernels, run, simulated, specs, surveying, testing, utc
    from evlcp_sdk.air import codebook, signing
    from evlcp_sdk.diagnosis import diagnose, facts, light_checks
    from evlcp_sdk.io import describe, interruptible, open, reconnect, replay, urls
    from evlcp_sdk.link import blocks, compose, resolve, several, text
    from evlcp_sdk.live import budget, loop, publisher, recorder, sender, server, tcp_output, viewer
    from evlcp_sdk.place import calibration, gnss, navigator, survey
    from evlcp_sdk.plugin import records, registry, roles
    from evlcp_sdk.report import diagnosis_page, drawing
    from evlcp_sdk.results import sinks
    from evlcp_sdk.rx import receiver
    from evlcp_sdk.scene import attitude, sites
    from evlcp_sdk.sim import scene, truth
    from evlcp_sdk.study import (
        collect,
        compare,
        comparison,
        frames,
        intervals,
        jobs,
        match,
        report,
        score,
        store,
        summary,
        tally,
        task,
    )
    from evlcp_sdk.testing import exercises, suite
else:
    __getattr__ = find_module(
        {
            "evlcp_sdk": "files kernels run simulated specs surveying testing utc",
            "evlcp_sdk.air": "codebook signing",
            "evlcp_sdk.diagnosis": "diagnose facts light_checks",
            "evlcp_sdk.io": "describe interruptible open reconnect replay urls",
            "evlcp_sdk.link": "blocks compose resolve several text",
            "evlcp_sdk.live": "budget loop publisher recorder sender server tcp_output viewer",
            "evlcp_sdk.place": "calibration gnss navigator survey",
            "evlcp_sdk.plugin": "records registry roles",
            "evlcp_sdk.report": "diagnosis_page drawing",
            "evlcp_sdk.results": "sinks",
            "evlcp_sdk.rx": "receiver",
            "evlcp_sdk.scene": "attitude sites",
            "evlcp_sdk.sim": "scene truth",
            "evlcp_sdk.study": "collect compare comparison frames intervals jobs match "
            "report score store summary tally task",
            "evlcp_sdk.testing": "exercises suite",
        }
    )
