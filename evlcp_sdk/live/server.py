"""The base of a live run's servers: a thread with an event loop, and how a server starts and ends."""

import asyncio
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.live.publisher import Publisher
from evlcp_sdk.live.recorder import Recorder

_T = TypeVar("_T")

FINISH_S = 1.0
"""Longest wait at the end of a run for a server to send the rest."""

_JOIN_S = 2.0
"""Longest wait at the end of a run for the loop's thread."""


class Server(ABC):
    """A server of a run's results, in the event loop of `serve`.

    Args:
        publisher: Gives the results.
        kinds: Kinds of results.
        most: Results that may wait for the server; beyond, the oldest are dropped.
        host: Address to listen at.
        port: Port to listen at; 0 for any free one.
        wake: Called after each result, in the thread that published it.

    Attributes:
        port: Its port, once started.
    """

    def __init__(
        self,
        publisher: Publisher,
        kinds: frozenset[str],
        most: int,
        host: str,
        port: int,
        wake: Callable[[], None] | None = None,
    ) -> None:
        self._publisher, self._host, self.port = publisher, host, port
        self._subscription = publisher.subscribe(kinds, most=most, wake=wake)
        self._unsent = 0

    @property
    @abstractmethod
    def url(self) -> str:
        """Its address, once started."""

    @property
    def dropped(self) -> int:
        """Number of results that were not sent, as clients or the server were too slow."""
        return self._subscription.dropped + self._unsent

    @abstractmethod
    async def _listen(self) -> Any:
        """Start to listen; return the server of `asyncio` or `websockets`."""

    @abstractmethod
    async def _send_news(self) -> None:
        """Send news until the subscription ends."""

    def _abort(self) -> None:  # noqa: B027
        """Close connections that the end of the loop leaves open."""

    async def start(self) -> "asyncio.Task[None]":
        """Start the server; return the task that ends when clients have got the rest.

        Raises:
            ConfigError: The port cannot be used, or a package is not installed.
        """
        try:
            listening = await self._listen()
        except OSError as fault:
            self._publisher.unsubscribe(self._subscription)
            has_number = fault.errno is not None and fault.errno > 0
            reason = os.strerror(fault.errno or 0) if has_number else fault.strerror or str(fault)
            expected = "expected an address of this machine and a port of it that is free, 0 for any"
            raise ConfigError(f"{self._host}:{self.port}: {reason}: {expected}") from fault
        self.port = next(iter(listening.sockets)).getsockname()[1]

        async def serve() -> None:
            try:
                await self._send_news()
            finally:
                self._publisher.unsubscribe(self._subscription)
                # A client that is just connecting is accepted first: asyncio would leave its connection open.
                # Its task, once begun, closes it when cancelled.
                for one in listening.sockets:
                    asyncio.get_running_loop().remove_reader(one.fileno())
                for _ in range(5):
                    await asyncio.sleep(0)
                self._abort()
                listening.close()

        return asyncio.create_task(serve())


@contextmanager
def serve(
    publisher: Publisher, servers: Iterable[Server], recorder: Recorder | None = None
) -> Iterator[None]:
    """Serve in a thread beside a live run; at the end, close the publisher and complete a recording.

    Raises:
        ConfigError: A port cannot be used, or a package is not installed.
    """
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=_run_loop, args=(loop,), name="evlcp-loop", daemon=True)
    thread.start()
    with ExitStack() as stack:
        stack.callback(thread.join, _JOIN_S)
        stack.callback(loop.call_soon_threadsafe, loop.stop)
        for server in servers:
            task = _call(loop, server.start())
            # So long, a server may send the rest.
            stack.callback(_call, loop, asyncio.wait([task], timeout=FINISH_S))
        stack.callback(publisher.close)
        if recorder is not None:
            stack.callback(recorder.close)
        yield


def _run_loop(loop: asyncio.AbstractEventLoop) -> None:
    """Run an event loop until it is stopped, and cancel its tasks."""
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.get_loop().run_forever()


def _call(loop: asyncio.AbstractEventLoop, job: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine in the loop; return its result, or raise its exception."""
    return asyncio.run_coroutine_threadsafe(job, loop).result()
