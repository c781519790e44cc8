"""The three classes of publisher as values (thesis 5.3.6), and what they signal."""

from collections.abc import Callable
from typing import Any, ClassVar, Generic, Literal, TypeVar

import msgspec

from r2p.durations import SHORTEST, seconds
from r2p.errors import MessageError
from r2p.messages import Message
from r2p.runtime.sample import PublisherClass
from r2p.runtime.topic import number

M = TypeVar("M", bound=Message)


class Missed(msgspec.Struct, frozen=True):
    """A message that did not reach everybody in time, or the news that it may not from now on.

    `where` names the subscriber's node or the link; `late` is in seconds (0: unknown); `count` is how many messages.
    """

    topic: str
    reason: str
    where: str = ""
    late: float = 0.0
    count: int = 1

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        late = f" by {self.late * 1e3:.1f} ms" if self.late else ""
        return f"topic {self.topic}{where}: {self.reason}{late}"


Signal = Callable[[Missed], object]


class NonRealTime(msgspec.Struct, frozen=True, kw_only=True):
    """Class of a publisher whose messages do not expire: `publish` waits for room up to `stall` seconds."""

    publisher_class: ClassVar = PublisherClass.NON_REAL_TIME
    stall: float = 1.0
    on_missed: Signal | None = None
    on_degraded: Signal | None = None


class Sporadic(msgspec.Struct, frozen=True):
    """Class of an event-triggered publisher: messages must be in every queue `deadline` seconds after `publish`.

    At most `pending` messages wait for room, in order. One that is overdue is given up (`late="drop"`) or still sent
    (`late="send"`); it is counted and signalled either way.
    """

    publisher_class: ClassVar = PublisherClass.SPORADIC
    deadline: float
    pending: int = 8
    late: Literal["drop", "send"] = "drop"
    on_missed: Signal | None = None
    on_late: Signal | None = None
    on_degraded: Signal | None = None


class Periodic(msgspec.Struct, Generic[M], frozen=True):
    """Class of a time-triggered publisher: `fill()` gives the message of each period (seconds); None skips one.

    Where a link has slots for it, they are the clock: `fill` is called `lead` seconds before each.
    """

    publisher_class: ClassVar = PublisherClass.PERIODIC
    period: float
    fill: Callable[[], M | None]
    lead: float = 0.001
    on_missed: Signal | None = None
    on_late: Signal | None = None
    on_degraded: Signal | None = None


def check_class(topic: str, klass: NonRealTime | Sporadic | Periodic[Any]) -> None:
    """Raise MessageError for a class value without sense."""
    match klass:
        case NonRealTime():
            seconds(f"topic {topic}: stall", klass.stall, least=0.0)
        case Sporadic():
            seconds(f"topic {topic}: deadline", klass.deadline, least=SHORTEST)
            number(topic, "pending", klass.pending)
            if klass.late not in ("drop", "send"):
                raise MessageError(f"topic {topic}: late is 'drop' or 'send', not {klass.late!r}")
        case Periodic():
            seconds(f"topic {topic}: period", klass.period, least=SHORTEST)
            seconds(f"topic {topic}: lead", klass.lead, least=0.0)
            if not callable(klass.fill):
                raise MessageError(f"topic {topic}: fill is a function that gives the message, not {klass.fill!r}")
        case _:
            raise MessageError(f"topic {topic}: give a class value, such as r2p.Sporadic(deadline=0.02), not {klass!r}")
    for name in ("on_missed", "on_late", "on_degraded"):
        signal = getattr(klass, name, None)
        if signal is not None and not callable(signal):
            raise MessageError(f"topic {topic}: {name} is a function that takes an r2p.Missed, not {signal!r}")
