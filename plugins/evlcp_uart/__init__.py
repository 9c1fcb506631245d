"""Asynchronous characters of one LED: start bit, data, parity, stop bits."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "framing", "uart", "evlcp_uart.framing:Uart", 1, "asynchronous characters of one LED, soft"
    )
