"""Where everything that happens is collected until the shell takes it: messages to send and news to act on."""

from collections import deque

from r2p.codecs import management
from r2p.protocols.events import Event, Send

_REMEMBERED = 256
"""Messages that are recognised when a line echoes them."""


class Outbox:
    """The events of one call. While the link is not `up` nothing is sent."""

    def __init__(self) -> None:
        self.up = False
        self._events: list[Event] = []
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)

    def say(self, *messages: management.Management, urgent: bool = False) -> None:
        if self.up:
            for message in messages:
                data = management.encode(message)
                self._sent.append(data)
                self._events.append(Send(data, urgent))

    def tell(self, event: Event) -> None:
        self._events.append(event)

    def take(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    def forget(self, data: bytes) -> bool:
        """Whether we sent this lately; each message is recognised once."""
        if data not in self._sent:
            return False
        self._sent.remove(data)
        return True
