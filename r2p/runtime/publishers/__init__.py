"""Publishers of the three classes of the thesis (5.3.6). They differ in what they do when a queue or link is full.

    non_real_time   waits for room, at most `stall` seconds, then goes on without the slow subscribers
    sporadic        never waits; a message that is not in every queue and on every link by its deadline is missed
    periodic        never waits; `fill` is called at every period, and the message is missed without room

Read `base` first: there each miss is counted, logged at most once a second, and given to the callbacks of the class
value (`r2p.runtime.qos`). Waiting messages are in the queues of `r2p.runtime.backpressure`.
"""

from typing import Any

from r2p.runtime.publishers.non_real_time import Publisher
from r2p.runtime.publishers.periodic import PeriodicPublisher
from r2p.runtime.publishers.sporadic import SporadicPublisher

__all__ = ["AnyPublisher", "PeriodicPublisher", "Publisher", "SporadicPublisher"]

AnyPublisher = Publisher[Any] | SporadicPublisher[Any] | PeriodicPublisher[Any]
