"""A thread in which the servers of a live run have their event loop, beside the receiver's."""

import asyncio
import os
import threading
from collections.abc import Coroutine, Iterable
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from evlcp_sdk.errors import ConfigError

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

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(_LEAVE_S)


class Listening(Protocol):
    """A server: of `asyncio`, or of `websockets`."""

    @property
    def sockets(self) -> Iterable[Any]:
        """Where it listens."""

    def close(self) -> None:
        """Listen no more."""


def cannot_listen(host: str, port: int, fault: OSError) -> ConfigError:
    """What is said where a server cannot listen."""
    known = fault.errno is not None and fault.errno > 0
    what = os.strerror(fault.errno or 0) if known else fault.strerror or str(fault)
    return ConfigError(
        f"{host}:{port}: {what}: expected an address of this machine and a port of it that is free, 0 for any"
    )


async def stop_listening(server: Listening) -> None:
    """Close a server. Who is just connecting is let in first: asyncio would forget that connection, open.

    Such a one's task has begun by then, and closes its connection when it is cancelled.
    """
    loop = asyncio.get_running_loop()
    for one in server.sockets:
        loop.remove_reader(one.fileno())
    for _ in range(5):
        await asyncio.sleep(0)
    server.close()
