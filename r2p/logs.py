"""The topic `log`: what the nodes of a module log goes to whoever subscribes it, at most RATE records a second."""

from r2p.messages import Timestamp
from r2p.msg import Log
from r2p.names import NODE_MAX
from r2p.node import Node
from r2p.topic import TopicSpace

TOPIC = "log"
RATE = 50
"""Records a second, and records that may come at once."""

_SECOND = 1_000_000_000
_TEXT = 128


class LogTopic:
    """Publishes log records; those beyond the rate are counted in `suppressed`, and the next one says so."""

    def __init__(self, space: TopicSpace) -> None:
        self.suppressed = 0
        self._space = space
        self._node = Node("log", space)
        self._publisher = self._node.advertise(TOPIC, Log)
        self._node.enter()
        self._credit = float(RATE)
        self._at = space.clock.monotonic()
        self._publishing = False

    def publish(self, level: int, node: str, text: str) -> None:
        """Publish one record; never waits, and never fails."""
        if self._publishing or not self._admit():
            self.suppressed += 1
            return
        if self.suppressed:
            text = f"({self.suppressed} suppressed) {text}"
            self.suppressed = 0
        printable = text.encode("ascii", "replace").replace(b"\0", b"?")[:_TEXT].decode()
        self._publishing = True  # a miss of the log topic is itself logged
        try:
            stamp = Timestamp.from_ns(self._space.clock.now())
            self._publisher.publish_nowait(
                Log(stamp=stamp, level=min(level, 255), node=node[:NODE_MAX], text=printable)
            )
        finally:
            self._publishing = False

    def close(self) -> None:
        self._node.close()

    def _admit(self) -> bool:
        now = self._space.clock.monotonic()
        self._credit = min(float(RATE), self._credit + (now - self._at) * RATE / _SECOND)
        self._at = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True
