"""The topic `log`: what the nodes of a module log goes to whoever subscribes it, at most RATE records a second.

A record is a line of text. A text of several lines is several records, and so is a traceback. Loggers are used from any
thread: what another one logs is published by the loop's.
"""

import contextlib
import threading

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

    def __init__(self, space: TopicSpace, remap: dict[str, str] | None = None) -> None:
        self.suppressed = 0
        self._space = space
        self._thread = threading.get_ident()
        self._node = Node("log", space, remap=remap)
        self._publisher = self._node.advertise(TOPIC, Log)
        self._credit = float(RATE)
        self._at = space.clock.monotonic()

    def publish(self, level: int, node: str, text: str) -> None:
        """Publish one record a line; never waits, and never fails. From any thread."""
        if threading.get_ident() != self._thread:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._space.loop.call_soon_threadsafe(self.publish, level, node, text)
            return
        for line in text.splitlines():
            self._publish_line(level, node, line)

    def close(self) -> None:
        """Publish no more."""
        self._node.close()

    def _publish_line(self, level: int, node: str, line: str) -> None:
        if self._node.closed or not self._admit():
            self.suppressed += 1
            return
        if self.suppressed:
            line = f"({self.suppressed} suppressed) {line}"
            self.suppressed = 0
        text = line.encode("ascii", "replace").replace(b"\0", b"?")[:_TEXT].decode()
        stamp = Timestamp.from_ns(self._space.clock.now())
        level = min(max(level, 0), 255)
        self._publisher.publish_nowait(Log(stamp=stamp, level=level, node=node[:NODE_MAX], text=text))

    def _admit(self) -> bool:
        now = self._space.clock.monotonic()
        self._credit = min(float(RATE), self._credit + (now - self._at) * RATE / _SECOND)
        self._at = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True
