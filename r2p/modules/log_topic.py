"""The topic `log` of a module, and the levels from which on its nodes log.

A node logs from the level of its logger on, and publishes from INFO up. A level that is set at run time counts for
both. It belongs to the name of the node: it outlives a crash, a swap and REBOOT, and ends with the module.
"""

import contextlib
import logging
import threading

from r2p.messages import Timestamp
from r2p.msg import Log
from r2p.names import LOG, module_alias, node_alias
from r2p.runtime.node import Node
from r2p.runtime.topic import TopicSpace
from r2p.units import SECOND

LOG_RATE = 50
"""Records a second on the topic `log`, and records that may come at once: an eighth of a CAN bus of 1 Mbit/s."""

_LOG_TEXT_MAX = 128  # characters of `Log.text`


class LogTopic:
    """Publishes log records; those beyond the rate are counted in `suppressed`, and the next record says how many."""

    def __init__(self, space: TopicSpace, remap: dict[str, str]) -> None:
        self.suppressed = 0
        self._space = space
        self._thread = threading.get_ident()
        self._node = Node(LOG, space, remap=remap)
        self._publisher = self._node.advertise(LOG, Log)
        self._credit = float(LOG_RATE)
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
        text = line.encode("ascii", "replace").replace(b"\0", b"?")[:_LOG_TEXT_MAX].decode()  # as firmware reads it
        stamp = Timestamp.from_ns(self._space.clock.now())
        level = min(max(level, 0), 255)
        module = module_alias(self._space.module)
        record = Log(stamp=stamp, level=level, module=module, node=node_alias(node), text=text)
        self._publisher.publish_nowait(record)

    def _within_rate(self) -> bool:
        now = self._space.clock.monotonic()
        self._credit = min(float(LOG_RATE), self._credit + (now - self._credited_at) * LOG_RATE / SECOND)
        self._credited_at = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True


class LogLevels:
    """The levels of nodes that were set at run time, by their names."""

    def __init__(self) -> None:
        self._levels: dict[str, int] = {}
        self._before: dict[logging.Logger, int] = {}
        """The levels of loggers as the program had set them."""

    def get(self, node: str) -> int | None:
        """Return the level that was set for a node; None: that of the start."""
        return self._levels.get(node)

    def set(self, node: Node, level: int | None) -> None:
        """Let a node, and those that take its name after it, log from this level on; None: as at the start."""
        if level is None:
            self._levels.pop(node.name, None)
            self._restore(node.log.logger)
            node.log.threshold = logging.INFO
        else:
            self._levels[node.name] = level
            self.apply(node)

    def apply(self, node: Node) -> None:
        """Give a node that starts the level that was set for its name."""
        level = self._levels.get(node.name)
        if level is not None:
            self._before.setdefault(node.log.logger, node.log.logger.level)
            node.log.logger.setLevel(level)
            node.log.threshold = level

    def close(self) -> None:
        """Give all loggers the levels of before: they outlive the module."""
        for logger in list(self._before):
            self._restore(logger)

    def _restore(self, logger: logging.Logger) -> None:
        before = self._before.pop(logger, None)
        if before is not None:
            logger.setLevel(before)
