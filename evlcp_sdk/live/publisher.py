"""Publishes the results of a live run to subscribers, without ever waiting for them."""

import threading
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Final

from evlcp_sdk.errors import StreamError
from evlcp_sdk.live.pictures import PictureSlot

KINDS: Final = ("frame", "packet", "message", "fix", "events", "triggers", "status", "end")
"""Kinds of news; see `evlcp_sdk.live`."""


@dataclass(frozen=True, eq=False)
class News:
    """One result of a live run.

    Attributes:
        kind: One of `KINDS`.
        t_us: Its time on the camera's clock, us.
        value: The result.
        late_ms: Delay of a frame after its last chip, ms; of a message `time` after its content. None where
            it is not known.
    """

    kind: str
    t_us: float
    value: Any
    late_ms: float | None = None


class Subscription:
    """A queue of the newest `most` news, made by `Publisher.subscribe`; it counts the ones dropped."""

    def __init__(self, kinds: frozenset[str], most: int, wake: Callable[[], None] | None) -> None:
        self.kinds = kinds
        self.dropped = 0
        self._most = most
        self._wake = wake
        self._queue: deque[News] = deque()
        self._filled = threading.Condition()
        self._closed = False

    @property
    def ended(self) -> bool:
        """Whether nothing more will come, and nothing is left."""
        return self._closed and not self._queue

    def take(self, timeout_s: float | None = None) -> list[News]:
        """Remove and return all news, oldest first.

        Waits `timeout_s` for some, 0 not at all, None until something comes or the subscription ends.
        """
        with self._filled:
            self._filled.wait_for(lambda: self._queue or self._closed, timeout_s)
            taken, self._queue = list(self._queue), deque()
        return taken

    def put(self, news: News) -> None:
        """Add news; a full queue drops the oldest."""
        with self._filled:
            if self._closed:
                return
            if len(self._queue) == self._most:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(news)
            self._filled.notify()
        if self._wake is not None:
            self._wake()

    def close(self) -> None:
        """End the queue; what is in it can still be taken."""
        with self._filled:
            self._closed = True
            self._filled.notify_all()
        if self._wake is not None:
            self._wake()


class Publisher:
    """Passes the results of a live run to subscriptions; any thread may subscribe, at any time.

    Attributes:
        pictures: Draws pictures of events on request.

    >>> publisher = Publisher()
    >>> mine = publisher.subscribe({"status"}, most=2)
    >>> for number in range(3):
    ...     publisher.publish("status", number, value=number)
    >>> [news.value for news in mine.take()], mine.dropped
    ([1, 2], 1)
    """

    def __init__(self) -> None:
        self.pictures = PictureSlot()
        self._subscriptions: tuple[Subscription, ...] = ()
        self._lock = threading.Lock()
        self._closed = False

    def subscribe(
        self, kinds: Collection[str] = KINDS, *, most: int = 1000, wake: Callable[[], None] | None = None
    ) -> Subscription:
        """Return a queue for the news from now on.

        Args:
            kinds: Kinds of news.
            most: Longest queue; beyond that the oldest are dropped, counted.
            wake: Called after each, in the thread that published it; must not wait.

        Raises:
            StreamError: A kind is not one of `KINDS`, or `most` is not positive.
        """
        if unknown := set(kinds) - set(KINDS):
            raise StreamError(f"news of kind {sorted(unknown)[0]!r}, expected {', '.join(KINDS)}")
        if most < 1:
            raise StreamError(f"a queue of {most} news, expected 1 or more")
        subscription = Subscription(frozenset(kinds), most, wake)
        with self._lock:
            if self._closed:
                subscription.close()
            else:
                self._subscriptions = (*self._subscriptions, subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """End a subscription; twice does no harm."""
        with self._lock:
            self._subscriptions = tuple(one for one in self._subscriptions if one is not subscription)
        subscription.close()

    def has_listeners(self, kind: str) -> bool:
        """Whether there are subscriptions to a kind."""
        return any(kind in one.kinds for one in self._subscriptions)

    def publish(self, kind: str, t_us: float, value: Any, late_ms: float | None = None) -> None:
        """Pass a result to all subscriptions to its kind."""
        news = News(kind, t_us, value, late_ms)
        for one in self._subscriptions:
            if kind in one.kinds:
                one.put(news)

    def close(self) -> None:
        """End all subscriptions and pictures; waiting news can still be taken."""
        with self._lock:
            self._closed = True
            subscriptions, self._subscriptions = self._subscriptions, ()
        for one in subscriptions:
            one.close()
        self.pictures.close()
