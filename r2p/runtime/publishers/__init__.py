"""Publishers: the three classes of the thesis (5.3.6), and what each does when somebody has no room.

    non real-time   waits for room, at most `stall` seconds, then goes on without the slow one
    sporadic        never waits; what is not in every queue and on every link by its deadline is missed
    periodic        never waits; is asked for a message at every period, which is missed where there is no room in it

Each counts its misses, signals them by a callback of its class value, and logs them at most once a second. What waits
stands in line before the sinks that lack it (`r2p.room`); here is what becomes of it there.
"""

from typing import Any

from r2p.runtime.publishers.non_real_time import Publisher
from r2p.runtime.publishers.periodic import PeriodicPublisher
from r2p.runtime.publishers.sporadic import SporadicPublisher

__all__ = ["AnyPublisher", "PeriodicPublisher", "Publisher", "SporadicPublisher"]

AnyPublisher = Publisher[Any] | SporadicPublisher[Any] | PeriodicPublisher[Any]
