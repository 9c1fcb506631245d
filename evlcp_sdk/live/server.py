"""What the servers of a live run share: a thread with an event loop, and how one listens and ends."""

import asyncio
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from typing import Any, Self, TypeVar

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.live.publisher import Publisher

_T = TypeVar("_T")

FINISH_S = 1.0
"""How long the end of a run waits for a server that has something to say still."""

_LEAVE_S = 2.0
"""How long the end of a run waits for the servers: what a client has not taken by then is left."""


class LoopThread:
    """An event loop in a thread of its own; a context manager, whose end cancels all that runs in it."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="evlcp-loop", daemon=True)

    def call(self, job: Coroutine[Any, Any, _T]) -> _T:
        """Run something in the loop; return what it returns, or raise what it raises."""
        return asyncio.run_coroutine_threadsafe(job, self.loop).result()

    def finish(self, task: "asyncio.Task[None]") -> None:
        """Wait until a task is done, a moment at the most."""

        async def wait() -> None:
            await asyncio.wait([task], timeout=FINISH_S)

        self.call(wait())

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self.loop) as runner:
            runner.get_loop().run_forever()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_fault: object) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(_LEAVE_S)


class Server(ABC):
    """A server of what a run publishes; runs in the loop of a `LoopThread`.

    Args:
        publisher: Where results come from.
        kinds: Of these.
        most: How many wait for the server; the oldest go.
        host: Where to listen.
        port: The same; 0 for any that is free.
        wake: Called when something has come, in the thread that published it.

    Attributes:
        port: Where it listens, once started.
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
        self._mine = publisher.subscribe(kinds, most=most, wake=wake)
        self._unsent = 0

    @property
    @abstractmethod
    def url(self) -> str:
        """Where it is to be found, once started."""

    @property
    def dropped(self) -> int:
        """Results that clients were not sent as they did not take them, or as there was no time, so far."""
        return self._mine.dropped + self._unsent

    @abstractmethod
    async def _listen(self) -> Any:
        """Begin to listen; the server of `asyncio` or `websockets`."""

    @abstractmethod
    async def _tell_all(self) -> None:
        """Send what comes until it has ended."""

    @abstractmethod
    def _abort(self) -> None:
        """Close connections that nothing else closes when the loop ends."""

    async def start(self) -> "asyncio.Task[None]":
        """Listen; the task that is done when clients have had the last words.

        Raises:
            ConfigError: The port cannot be had, or a package is not installed.
        """
        try:
            listening = await self._listen()
        except OSError as fault:
            self._publisher.leave(self._mine)
            known = fault.errno is not None and fault.errno > 0
            what = os.strerror(fault.errno or 0) if known else fault.strerror or str(fault)
            expected = "expected an address of this machine and a port of it that is free, 0 for any"
            raise ConfigError(f"{self._host}:{self.port}: {what}: {expected}") from fault
        self.port = next(iter(listening.sockets)).getsockname()[1]

        async def serve() -> None:
            try:
                await self._tell_all()
            finally:
                self._publisher.leave(self._mine)
                # Who is just connecting is let in first: asyncio would forget that connection, open. Its task
                # has begun by then, and closes its connection when it is cancelled.
                for one in listening.sockets:
                    asyncio.get_running_loop().remove_reader(one.fileno())
                for _ in range(5):
                    await asyncio.sleep(0)
                self._abort()
                listening.close()

        return asyncio.create_task(serve())
