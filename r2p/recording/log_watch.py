"""The log records of all modules, as a recorder writes them: as those of ROS, which Foxglove and rqt show as a log."""

import asyncio
from collections.abc import Callable

from r2p.errors import Error
from r2p.log_lines import get_logger
from r2p.messages import Message
from r2p.modules.module import Module
from r2p.msg import Log
from r2p.names import LOG, module_alias
from r2p.recording.messages import LOGS, TEXT_MAX, LogRecord, cut
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample

_NODE = "log_watch"
_QUEUE = 1024
_TOPICS_MAX = 64  # names come from the network

logger = get_logger("r2p.recording")


class LogWatch:
    """Records what modules log, also those of other robots behind a gateway; `look` is called once a second."""

    def __init__(self, module: Module, record: Callable[[str, Message], None]) -> None:
        self._module = module
        self._record = record
        self._node = Node(_NODE, module.space)
        self._topics: set[str] = set()

    def look(self, tasks: asyncio.TaskGroup) -> None:
        """Subscribe to the log, and to that of each namespace that is new."""
        found = {LOG, *(name for name in self._module.network.topics() if name.endswith(f"/{LOG}"))}
        for topic in sorted(found - self._topics)[: _TOPICS_MAX - len(self._topics)]:
            self._topics.add(topic)
            tasks.create_task(self._follow(topic), name=f"recorder follows {topic}")

    def close(self) -> None:
        """End the subscription."""
        self._node.close()

    async def _follow(self, topic: str) -> None:
        try:
            subscriber = self._node.subscribe(topic, Log, queue=_QUEUE, lossy=True)
        except Error as error:  # a program uses the name for messages of its own
            logger.warning("the recording has no %s: %s", topic, error)
            return
        async for sample in subscriber.samples():
            self._record(LOGS, log_record(sample, topic.removesuffix(LOG)))


def log_record(sample: Sample[Log], namespace: str = "") -> LogRecord:
    """Return a log record as it is recorded; `namespace` ends with a slash."""
    record = sample.message
    sender = sample.source.module
    module = sender if module_alias(sender.rpartition("/")[2]) == record.module else record.module
    module = namespace + module if module and "/" not in module else module
    name = "/".join(filter(None, (module, record.node)))
    return LogRecord(stamp=record.stamp, level=record.level, name=cut(name), msg=cut(record.text, TEXT_MAX))
