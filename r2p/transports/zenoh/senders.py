"""What zenoh sends the messages of a link with, and how far each topic has come; both outlast the outlets."""

import functools
from typing import TYPE_CHECKING

from r2p.protocols.flow import Outflow
from r2p.sample import PublisherClass
from r2p.topic import Topic
from r2p.transports.zenoh.lane import Put, nowhere
from r2p.transports.zenoh.outbound import MOST, MOST_URGENT

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.session import Session


class Senders:
    """One for each topic and class, declared as soon as somebody publishes: so zenoh looks for a way in good time."""

    def __init__(self) -> None:
        self._session: Session | None = None
        self._prefix = ""
        self._senders: dict[tuple[str, int], zenoh.Publisher] = {}
        self._asked: set[str] = set()
        self._answers: dict[str, bool] = {}
        self._flows: dict[tuple[str, int], Outflow] = {}

    def connect(self, session: "Session", prefix: str) -> None:
        """There is a session now; the key of a topic is its name behind the prefix."""
        self._session = session
        self._prefix = prefix

    def close(self) -> None:
        """Sent is nothing any more; what is declared goes with the session."""
        self._session = None

    def declare(self, topic: Topic) -> None:
        """Somebody publishes it."""
        classes = {int(publisher.publisher_class) for publisher in topic.publishers}
        for publisher_class in classes or {int(PublisherClass.NON_REAL_TIME)}:  # none of our own: a gateway
            self.publisher(topic.name, publisher_class)

    def undeclare(self, topic: str) -> None:
        """Nobody does any more."""
        for key in [key for key in self._senders if key[0] == topic]:
            sender = self._senders.pop(key)
            if self._session is not None:
                self._session.ends(sender)

    def reach(self, topic: str) -> bool:
        """Whether zenoh knows of a subscriber that messages of the topic reach. False while zenoh has yet to say it."""
        senders = [sender for (name, _), sender in self._senders.items() if name == topic]
        if not senders or self._session is None:
            return False
        outbound = self._session.outbound
        if not outbound.by_thread:
            return all(_reaches(sender) for sender in senders)
        answer = self._answers.pop(topic, None)
        if answer is None and topic not in self._asked:
            self._asked.add(topic)
            outbound.ask(lambda: all(_reaches(sender) for sender in senders), functools.partial(self._answer, topic))
        return bool(answer)

    def _answer(self, topic: str, reached: bool | None) -> None:
        self._asked.discard(topic)
        self._answers[topic] = bool(reached)

    def put(self, topic: str, publisher_class: int) -> Put:
        """What sends packets of the topic."""
        sender = self.publisher(topic, publisher_class)
        if sender is None or self._session is None:
            return nowhere
        most = MOST if publisher_class == PublisherClass.NON_REAL_TIME else MOST_URGENT
        return functools.partial(self._session.outbound.put, sender.put, most)

    def publisher(self, topic: str, publisher_class: int) -> "zenoh.Publisher | None":
        """What zenoh sends with."""
        key = topic, publisher_class
        if key not in self._senders and self._session is not None:
            self._senders[key] = self._session.publisher(f"{self._prefix}{topic}", publisher_class)
        return self._senders.get(key)

    def flow(self, topic: str, publisher_class: int) -> Outflow:
        """What went out on the topic; it counts on for as long as the link lives."""
        return self._flows.setdefault((topic, publisher_class), Outflow())


def _reaches(sender: "zenoh.Publisher") -> bool:
    """zenoh's stubs tell of a bool; what comes is an object that says it, and is itself always true."""
    status: object = sender.matching_status
    return bool(getattr(status, "matching", status))
