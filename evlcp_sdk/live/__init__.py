"""Receiving in real time: a source read in slices, a budget of time, and results for whoever listens.

```
source --reader (a thread)--> slices --LiveLoop--> receiver --> Publisher --> Subscription, Subscription, ...
                                                     +-> PictureSlot (drawn when asked for, the newest only)
```

How a viewer, a server or a recorder subscribes, from threads of its own, is in `docs/live.md`. A picture is
drawn on request: `publisher.pictures.wait(timeout_s=0.5)`. What is published:

| kind | value | when |
|---|---|---|
| `frame` | `Frame` | as soon as it is decoded, with `late_ms` after its last chip |
| `packet` | `Packet` | when it is complete; its frames came before |
| `message` | `ReceivedMessage` | when a packet completes it |
| `fix` | `Placed` | when it is computed: the fix, given or refused, and the filtered place |
| `events` | `Events` | each piece of the source, before anything is shed: for a recorder |
| `triggers` | `Triggers` | each piece's, where there are any, before its events |
| `status` | `LiveStatus` | every 0.2 s, and at the end: rate, regions, delays, losses, what is shed |
| `end` | the summary, a `dict` | last |
"""

from evlcp_sdk.live.budget import Budget, Shedder
from evlcp_sdk.live.delays import DelayTally
from evlcp_sdk.live.loop import LiveLoop, LiveStatus
from evlcp_sdk.live.pictures import Picture, PictureSlot
from evlcp_sdk.live.publisher import KINDS, News, Publisher, Subscription

__all__ = [
    "KINDS",
    "Budget",
    "DelayTally",
    "LiveLoop",
    "LiveStatus",
    "News",
    "Picture",
    "PictureSlot",
    "Publisher",
    "Shedder",
    "Subscription",
]
