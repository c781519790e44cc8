"""The topic `log`: what the nodes of a module log goes to its subscribers, at most RATE records a second."""

import contextlib
import threading

from r2p.messages import Timestamp
from r2p.msg import Log
from r2p.names import NODE_MAX
from r2p.runtime.node import Node
from r2p.runtime.topic import TopicSpace
from r2p.units import SECOND

TOPIC = "log"

RATE = 50
"""Records a second, and records that may come at once: an eighth of a CAN bus of 1 Mbit/s."""

_TEXT_MAX = 128  # characters of `Log.text`


class LogTopic:
    """Publishes log records; those beyond the rate are counted in `suppressed`, and the next one says how many."""

    def __init__(self, space: TopicSpace, remap: dict[str, str] | None = None) -> None:
        self.suppressed = 0
        self._space = space
        self._thread = threading.get_ident()
        self._node = Node("log", space, remap=remap)
        self._publisher = self._node.advertise(TOPIC, Log)
        self._credit = float(RATE)
        self._credited_at = space.clock.monotonic()

    def publish(self, level: int, node: str, text: str) -> None:
        """Publish each line as a record, from any thread; never waits, and never fails."""
        if threading.get_ident() != self._thread:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._space.loop.call_soon_threadsafe(self.publish, level, node, text)
            return
        for line in text.splitlines():
            self._publish_line(level, node, line)

    def close(self) -> None:
        """Stop publishing."""
        self._node.close()

    def _publish_line(self, level: int, node: str, line: str) -> None:
        if self._node.closed or not self._within_rate():
            self.suppressed += 1
            return
        if self.suppressed:
            line = f"({self.suppressed} suppressed) {line}"
            self.suppressed = 0
        text = line.encode("ascii", "replace").replace(b"\0", b"?")[:_TEXT_MAX].decode()  # as firmware reads it
        stamp = Timestamp.from_ns(self._space.clock.now())
        level = min(max(level, 0), 255)
        self._publisher.publish_nowait(Log(stamp=stamp, level=level, node=node[:NODE_MAX], text=text))

    def _within_rate(self) -> bool:
        now = self._space.clock.monotonic()
        self._credit = min(float(RATE), self._credit + (now - self._credited_at) * RATE / SECOND)
        self._credited_at = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True
