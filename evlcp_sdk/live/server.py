"""The base of a live run's servers: a thread with an event loop, and how a server starts and ends."""

import asyncio
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Self, TypeVar

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.live.publisher import Publisher
from evlcp_sdk.live.recorder import Recorder

_T = TypeVar("_T")

FINISH_S = 1.0
"""Longest wait at the end of a run for a server to send the rest."""

_JOIN_S = 2.0
"""Longest wait at the end of a run for the loop's thread."""


class LoopThread:
    """An event loop in a thread of its own; a context manager, whose end cancels its tasks."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="evlcp-loop", daemon=True)

    def call(self, job: Coroutine[Any, Any, _T]) -> _T:
        """Run a coroutine in the loop; return its result, or raise its exception."""
        return asyncio.run_coroutine_threadsafe(job, self.loop).result()

    def finish(self, task: "asyncio.Task[None]") -> None:
        """Wait until a task is done, for `FINISH_S` at most."""
        self.call(asyncio.wait([task], timeout=FINISH_S))

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self.loop) as runner:
            runner.get_loop().run_forever()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_fault: object) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(_JOIN_S)


class Server(ABC):
    """A server of a run's results, in the loop of a `LoopThread`.

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
    with ExitStack() as stack:
        loop_thread = stack.enter_context(LoopThread())
        for server in servers:
            stack.callback(loop_thread.finish, loop_thread.call(server.start()))
        stack.callback(publisher.close)
        if recorder is not None:
            stack.callback(recorder.close)
        yield
