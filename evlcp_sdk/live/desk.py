"""A thread in which the servers of a live run have their event loop, beside the receiver's."""

import asyncio
import threading
from collections.abc import Coroutine
from types import TracebackType
from typing import Any, Self, TypeVar

__all__ = ["Desk"]

_T = TypeVar("_T")

_LEAVE_S = 2.0
"""How long the end of a run waits for the servers: what a client has not taken by then is left."""


class Desk:
    """An event loop in a thread of its own; a context manager, whose end cancels all that runs in it."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="evlcp-desk", daemon=True)

    def call(self, job: Coroutine[Any, Any, _T]) -> _T:
        """Run something in the loop; return what it returns, or raise what it raises."""
        return asyncio.run_coroutine_threadsafe(job, self.loop).result()

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        self.loop.run_forever()
        for task in asyncio.all_tasks(self.loop):
            task.cancel()
        self.loop.run_until_complete(_gone(self.loop))
        self.loop.run_until_complete(self.loop.shutdown_asyncgens())
        self.loop.run_until_complete(self.loop.shutdown_default_executor())
        self.loop.close()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(_LEAVE_S)


async def _gone(loop: asyncio.AbstractEventLoop) -> None:
    """Let what is cancelled end."""
    others = [task for task in asyncio.all_tasks(loop) if task is not asyncio.current_task()]
    await asyncio.wait_for(asyncio.gather(*others, return_exceptions=True), _LEAVE_S / 2)
    # Their connections are let go in the turns that follow.
    for _ in range(3):
        await asyncio.sleep(0)
