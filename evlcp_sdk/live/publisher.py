"""What a live run finds, given to whoever listens, without ever waiting for them."""

import threading
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Final

from evlcp_sdk.errors import StreamError
from evlcp_sdk.live.pictures import PictureSlot

KINDS: Final = ("frame", "packet", "message", "fix", "events", "triggers", "status", "end")
"""What is published; see `evlcp_sdk.live`."""


@dataclass(frozen=True, eq=False)
class News:
    """One thing that a live run found.

    Attributes:
        kind: One of `KINDS`.
        t_us: Its time on the camera's clock, us.
        value: What it is.
        late_ms: Of a frame, how long after its last chip it was there, ms; of a message `time`, how long
            after what it says. None where that is not known.
    """

    kind: str
    t_us: float
    value: Any
    late_ms: float | None = None


class Subscription:
    """A queue of news, the newest `most`; made by `Publisher.subscribe`.

    Attributes:
        dropped: News that were pushed out of the queue by newer ones, so far.
    """

    def __init__(self, kinds: frozenset[str], most: int, wake: Callable[[], None] | None) -> None:
        self.kinds = kinds
        self.dropped = 0
        self._most = most
        self._wake = wake
        self._queue: deque[News] = deque()
        self._filled = threading.Condition()
        self._over = False

    @property
    def ended(self) -> bool:
        """Nothing more will come, and nothing is left."""
        return self._over and not self._queue

    def take(self, timeout_s: float | None = None) -> list[News]:
        """Return all that has come, oldest first; waits for something.

        Args:
            timeout_s: How long at the most, s; 0 not at all, None for as long as something may come.
        """
        with self._filled:
            if not self._queue and not self._over and timeout_s != 0:
                self._filled.wait_for(lambda: self._queue or self._over, timeout_s)
            taken, self._queue = list(self._queue), deque()
        return taken

    def put(self, news: News) -> None:
        """Take one thing; of a queue that is full the oldest goes."""
        with self._filled:
            if self._over:
                return
            if len(self._queue) == self._most:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(news)
            self._filled.notify()
        if self._wake is not None:
            self._wake()

    def close(self) -> None:
        """Take nothing more; what is there can still be taken."""
        with self._filled:
            self._over = True
            self._filled.notify_all()
        if self._wake is not None:
            self._wake()


class Publisher:
    """Gives what a live run finds to its subscriptions; any thread may subscribe, at any time.

    Attributes:
        pictures: Where a picture of events is drawn when it is asked for.

    >>> publisher = Publisher()
    >>> mine = publisher.subscribe({"status"}, most=2)
    >>> for number in range(3):
    ...     publisher.publish("status", number, value=number)
    >>> [news.value for news in mine.take()], mine.dropped
    ([1, 2], 1)
    """

    def __init__(self) -> None:
        self.pictures = PictureSlot()
        self._all: tuple[Subscription, ...] = ()
        self._lock = threading.Lock()
        self._closed = False

    def subscribe(
        self, kinds: Collection[str] = KINDS, *, most: int = 1000, wake: Callable[[], None] | None = None
    ) -> Subscription:
        """Return a queue that news come to from now on.

        Args:
            kinds: Which.
            most: How many wait at the most; beyond that the oldest go, counted.
            wake: Called when something has come, in the thread that published it; must not wait.

        Raises:
            StreamError: A kind is not one of `KINDS`, or `most` is not positive.
        """
        if unknown := set(kinds) - set(KINDS):
            raise StreamError(f"news of kind {sorted(unknown)[0]!r}, expected {', '.join(KINDS)}")
        if most < 1:
            raise StreamError(f"a queue of {most} news, expected 1 or more")
        mine = Subscription(frozenset(kinds), most, wake)
        with self._lock:
            if self._closed:
                mine.close()
            else:
                self._all = (*self._all, mine)
        return mine

    def leave(self, subscription: Subscription) -> None:
        """Let a subscription go; twice does no harm."""
        with self._lock:
            self._all = tuple(one for one in self._all if one is not subscription)
        subscription.close()

    def wanted(self, kind: str) -> bool:
        """Whether somebody listens to a kind."""
        return any(kind in one.kinds for one in self._all)

    def publish(self, kind: str, t_us: float, value: Any, late_ms: float | None = None) -> None:
        """Give something to all who listen to its kind."""
        listeners = [one for one in self._all if kind in one.kinds]
        if not listeners:
            return
        news = News(kind, t_us, value, late_ms)
        for one in listeners:
            one.put(news)

    def close(self) -> None:
        """End all subscriptions, of which what waits can still be taken, and pictures."""
        with self._lock:
            self._closed = True
            everyone, self._all = self._all, ()
        for one in everyone:
            one.close()
        self.pictures.close()
