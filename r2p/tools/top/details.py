"""What the screens of `r2p top` share: the session, the monitor, and the topics that are measured."""

import r2p
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.tools.session import Session
from r2p.tools.types import Types

MEASURED_MAX = 50
"""Topics that are measured at once: each is a subscription, whose messages take a part of the network."""


class TopDetails:
    """The network that is shown, and what may be changed on it."""

    def __init__(self, session: Session, monitor: NetworkMonitor, *, allow_control: bool = False) -> None:
        self.session = session
        self.monitor = monitor
        self.allow_control = allow_control
        self.types = Types(session.settings)
        self._measured: set[str] = set()

    def toggle_measuring(self, topic: str) -> str:
        """Measure a topic, or end that, and return what has been done."""
        if topic in self._measured:
            self._measured.remove(topic)
            self.monitor.stop_measuring(topic)
            return f"{topic} is measured no more"
        if len(self._measured) >= MEASURED_MAX:
            return f"{MEASURED_MAX} topics are measured already: end one with m first"
        try:
            self.measure(topic)
        except r2p.Error as error:
            return f"{topic} can't be measured: {error}"
        return f"{topic} is measured: this tool subscribes to it; m ends that"

    def measure(self, topic: str) -> None:
        """Measure a topic until the end. Raises InvalidName and NameTooLong."""
        self.monitor.measure(topic)
        self._measured.add(topic)

    async def type_of(self, topic: str) -> type[r2p.Message] | None:
        """Return the type of a topic; ask the network for it."""
        view = self.session.module.network.topics().get(topic)
        return None if view is None else await self.types.learn(self.session, view)

    @property
    def snapshot(self) -> NetworkSnapshot:
        """The newest figures."""
        return self.monitor.snapshot
