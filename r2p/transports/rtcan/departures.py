"""What goes out over an RTCAN bus: samples by their deadlines, management as the network of the others wants it."""

from collections.abc import Sequence

import msgspec

from r2p.clock import Clock
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import NEVER, Action, Profile
from r2p.sample import PublisherClass, Sample
from r2p.topic import Advertised
from r2p.transports.outlet import LinkOutlet
from r2p.transports.rtcan import origins
from r2p.transports.rtcan.handover import Handover, publisher_of
from r2p.transports.rtcan.periodics import Periodics
from r2p.transports.rtcan.port import CanPort

_SECOND = 1_000_000_000
_DEADLINE = 50_000_000  # ns; of real-time messages that do not say: from other links, or latched
_NRT = PublisherClass.NON_REAL_TIME
_RESPONSE = 0x23


class Response(msgspec.Struct, eq=False):
    """A SUBSCRIBE_RESPONSE on its way."""

    sent: bool = False


class Departures:
    """Hands to the engine what a link sends; `periodics` are its periodic topics, `clock` is the module's."""

    def __init__(self, engine: Engine, port: CanPort, handover: Handover, periodics: Periodics, clock: Clock) -> None:
        self._engine = engine
        self._now = port.now
        self._handover = handover
        self._periodics = periodics
        self._clock = clock
        self._response: Response | None = None
        self._coming: dict[str, Response] = {}  # topics that will have subscribers when it is there

    def send(self, outlet: LinkOutlet | None, topic: str, high: int, sample: Sample) -> Sequence[Action]:
        """A sample of a topic, which has this high byte, and an outlet if this module has the topic."""
        now, drop = self._now(), sample.drop_late
        publisher = publisher_of(outlet.topic, sample) if outlet is not None else None
        deadline = NEVER if sample.publisher_class == _NRT else now + self._time_left(topic, sample, publisher)
        handed = self._handover.enter(publisher, sample, deadline)
        return self._engine.publish(now, high, sample.data, deadline=deadline, drop=drop, handle=handed)

    def manage(self, data: bytes, *, urgent: bool) -> Sequence[Action]:
        """A management message; its sender must be told where all have one id."""
        handle = None
        if data[-1] == _RESPONSE and self._engine.ready:
            handle = self._response = Response()
        if self._engine.profile is Profile.FIRMWARE:
            data = origins.mark(data)
        return self._engine.manage(self._now(), data, urgent=urgent, handle=handle)

    def follows_response(self, topic: str) -> bool:
        """Whether a topic has to wait till the last response is on the bus: an urgent message would overtake it, and
        find nobody.
        """
        if self._response is None or self._response.sent:
            return False
        self._coming[topic] = self._response
        return True

    def answered(self, response: Response) -> list[str]:
        """It is on the bus: the topics that waited for it."""
        response.sent = True
        topics = [topic for topic, awaited in self._coming.items() if awaited is response]
        for topic in topics:
            del self._coming[topic]
        return topics

    def forget(self, topic: str) -> None:
        """Nobody wants the topic any more."""
        self._coming.pop(topic, None)

    def _time_left(self, topic: str, sample: Sample, publisher: Advertised | None) -> int:
        """Ns until the deadline; a latched value that is sent once more has a new one."""
        left = (sample.expires or sample.deadline) - self._clock.now() if sample.deadline else 0
        if left > 0 or (sample.deadline and not (publisher is not None and publisher.latch)):
            return left
        slotted = self._periodics.by_topic.get(topic)
        return round(slotted.publisher.period * _SECOND) if slotted is not None else _DEADLINE
