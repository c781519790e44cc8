"""The log records of all modules on a network, those of robots behind gateways included.

Each r2p module publishes what its nodes log, from INFO up, on the topic `log`; behind a gateway with a prefix that is
`robot1/log`. Nothing keeps these records, so only new ones are seen, and on a CAN bus they take capacity: subscribe
only while a user looks at them.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self

import msgspec

from r2p.errors import Closed, DecodeError, Error
from r2p.log_lines import get_logger
from r2p.messages import layout
from r2p.modules.module import Module
from r2p.msg import Log
from r2p.names import LOG, module_alias
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample

RECORDS_MAX = 1000
"""The newest records, which `LogFollower.records` has."""

_NODE = "log_follower"
_TOPICS_MAX = 64  # names come from the network
_LOOK = 1.0  # seconds between two looks for the log topics of further namespaces

logger = get_logger("r2p.monitoring")


class LogEntry(msgspec.Struct, frozen=True, gc=False):
    """A log record. `stamp` is UTC (ns), `level` as in Python's logging: 10 debug to 50 critical.

    `module` has the prefix of its robot; it and `node` are empty where they are unknown.
    """

    stamp: int
    level: int
    module: str
    node: str
    text: str


LogListener = Callable[[LogEntry], None]
"""Gets each record as it arrives; must not raise."""


class LogFollower:
    """Subscribes to the log of all modules while its block is open."""

    def __init__(self, module: Module) -> None:
        self.records: deque[LogEntry] = deque(maxlen=RECORDS_MAX)
        """The newest records, oldest first."""
        self.received = 0
        """All records so far."""
        self.undecodable = 0
        """Messages on the log topics that are not log records."""
        self.listeners: list[LogListener] = []
        self._module = module
        self._node = Node(_NODE, module.space)
        self._subscribers: dict[str, ImmediateSubscriber] = {}

    async def __aenter__(self) -> Self:
        """Subscribe. Raises Closed if the module is not open."""
        self._look()
        self._task = asyncio.create_task(self._run(), name=f"{self._module.name} log follower")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        for subscriber in self._subscribers.values():
            subscriber.close()
        self._node.close()

    async def _run(self) -> None:
        with contextlib.suppress(Closed):
            while True:
                await asyncio.sleep(_LOOK)
                self._look()

    def _look(self) -> None:
        """Subscribe to the log, and to that of each namespace that is new."""
        named = (name for link in self._module.links for name in link.discovery.topics if name.endswith(f"/{LOG}"))
        for topic in sorted({LOG, *named} - self._subscribers.keys())[: _TOPICS_MAX - len(self._subscribers)]:
            self._subscribe(topic, topic.removesuffix(LOG))

    def _subscribe(self, topic: str, namespace: str) -> None:
        def handle(sample: Sample) -> None:
            self._handle(sample, namespace)

        subscriber = ImmediateSubscriber(self._module.space, self._node, handle, lossy=True)
        self._subscribers[topic] = subscriber
        try:
            subscriber.open(topic, layout(Log))
        except Error as error:  # a program uses the name for messages of its own
            logger.warning("the log has no %s: %s", topic, error)

    def _handle(self, sample: Sample, namespace: str) -> None:
        record = sample.message
        if record is None:
            try:
                record = layout(Log).decode(sample.data)
            except DecodeError:
                self.undecodable += 1
                return
        if not isinstance(record, Log):
            self.undecodable += 1
            return
        self.received += 1
        entry = log_entry(record, sample.source.module, sample.stamp, namespace)
        self.records.append(entry)
        for listener in self.listeners:
            listener(entry)


def log_entry(record: Log, sender: str, stamp: int, namespace: str = "") -> LogEntry:
    """Return a record with the name that its module has on this network.

    The record has its name on the robot, or the alias of a longer one. `sender` is the name with which the message
    came, and empty where the link carries none; `namespace` is that of the topic, and ends with a slash. `stamp` is for
    records without one.
    """
    is_sender = sender.endswith(record.module) or module_alias(sender.rpartition("/")[2]) == record.module
    module = sender if is_sender else record.module
    module = namespace + module if module and "/" not in module else module
    return LogEntry(record.stamp.ns or stamp, record.level, module, record.node, record.text)
