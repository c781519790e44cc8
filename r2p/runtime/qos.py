"""The three classes of publisher as values (thesis 5.3.6), and their reports to callbacks."""

import enum
from collections.abc import Callable
from typing import Any, ClassVar, Generic, Literal, TypeVar

import msgspec

from r2p.clock import SHORTEST, check_seconds
from r2p.errors import MessageError
from r2p.messages import Message
from r2p.runtime.sample import PublisherClass

M = TypeVar("M", bound=Message)


class Missed(msgspec.Struct, frozen=True):
    """A message that did not reach every subscriber in time, or a notice that messages may not from now on.

    Publishers log it, and give it to `on_missed`, `on_late` or `on_degraded` of their class. `where` names the node of
    the subscriber, or the link; `late` is in seconds (0: unknown); `count` is the number of messages.
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


class SignalKind(enum.Enum):
    """The kinds of signals: a message was missed, or late; or a link no longer meets the class."""

    MISSED = "missed"
    LATE = "late"
    DEGRADED = "degraded"


class PublisherSignal(msgspec.Struct, frozen=True):
    """A signal of a publisher, as `TopicSpace.signal_listeners` get it.

    `sequence` is that of the message (0: unknown). A message that is missed on several links has a signal for each, and
    only the first of them counts it (`missed.count`).
    """

    kind: SignalKind
    node: str
    publisher_class: PublisherClass
    sequence: int
    missed: Missed


class NonRealTime(msgspec.Struct, frozen=True, kw_only=True):
    """The class of a publisher whose messages do not expire.

    `publish()` waits for room up to `stall` seconds; then it goes on without the subscribers that have none, and calls
    `on_missed`. `on_degraded` is called when a link that carried the topic goes down.
    """

    publisher_class: ClassVar = PublisherClass.NON_REAL_TIME
    on_late: ClassVar = None
    stall: float = 1.0
    on_missed: Signal | None = None
    on_degraded: Signal | None = None


class Sporadic(msgspec.Struct, frozen=True):
    """The class of an event-triggered publisher: a message is due in every queue `deadline` seconds after `publish()`.

    At most `pending` messages wait for room, in order; one more drops the oldest of them. An overdue message is dropped
    (`late="drop"`) and reported to `on_missed`, or still sent (`late="send"`) and reported to `on_late`. `on_degraded`
    is called when a link can no longer meet the class.
    """

    publisher_class: ClassVar = PublisherClass.SPORADIC
    deadline: float
    pending: int = 8
    late: Literal["drop", "send"] = "drop"
    on_missed: Signal | None = None
    on_late: Signal | None = None
    on_degraded: Signal | None = None


class Periodic(msgspec.Struct, Generic[M], frozen=True):
    """The class of a time-triggered publisher: `fill()` returns the message of each period; None skips the period.

    `period` is in seconds. Where a link has reserved slots for the topic, these are the clock: `fill` is called `lead`
    seconds before each slot. A message that misses its period or its slot is reported to `on_missed`; a period that
    begins late, or was skipped because the event loop was blocked, to `on_late`; the loss of a link or of its slots to
    `on_degraded`.
    """

    publisher_class: ClassVar = PublisherClass.PERIODIC
    period: float
    fill: Callable[[], M | None]
    lead: float = 0.001
    on_missed: Signal | None = None
    on_late: Signal | None = None
    on_degraded: Signal | None = None


def check_class(topic: str, klass: NonRealTime | Sporadic | Periodic[Any]) -> None:
    """Raise MessageError for an invalid class value."""
    match klass:
        case NonRealTime():
            check_seconds(f"topic {topic}: stall", klass.stall, least=0.0)
        case Sporadic():
            check_seconds(f"topic {topic}: deadline", klass.deadline, least=SHORTEST)
            check_count(topic, "pending", klass.pending)
            if klass.late not in ("drop", "send"):
                raise MessageError(f"topic {topic}: late is 'drop' or 'send', not {klass.late!r}")
        case Periodic():
            check_seconds(f"topic {topic}: period", klass.period, least=SHORTEST)
            check_seconds(f"topic {topic}: lead", klass.lead, least=0.0)
            if not callable(klass.fill):
                raise MessageError(f"topic {topic}: fill is a function that returns the message, not {klass.fill!r}")
        case _:
            raise MessageError(f"topic {topic}: give a class value, such as r2p.Sporadic(deadline=0.02), not {klass!r}")
    for name in ("on_missed", "on_late", "on_degraded"):
        signal = getattr(klass, name, None)
        if signal is not None and not callable(signal):
            raise MessageError(f"topic {topic}: {name} is a function that takes an r2p.Missed, not {signal!r}")


def check_count(topic: str, option: str, value: object, of: str = "messages") -> None:
    """Raise MessageError unless the value is a number of messages, or of something else."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise MessageError(f"topic {topic}: {option} is a number of {of}, 1 or more, not {value!r}")
