"""The message classes of topics that this module does not use itself.

A type is one that the user states, that of this module's own nodes, one of `r2p.msg` with the fingerprint that the
topic's publishers announce, or one that other modules are asked for: each once, and again ten seconds after a question
without an answer.
"""

import asyncio
from collections.abc import Callable, Mapping

from r2p.errors import Error
from r2p.messages import Message, layout
from r2p.modules.module import Module
from r2p.msg import Log
from r2p.names import LOG
from r2p.ros.classes import standard_classes
from r2p.units import SECOND

UNANNOUNCED: Mapping[str, type[Message]] = {LOG: Log}
"""The types of r2p's own topics, for firmware, which announces none."""

_LEARNT_MAX = 4096  # fingerprints come from the network
_ASKED_AGAIN = 10 * SECOND  # ns after a question for a type that found none

_Key = tuple[bytes, str]
"""A fingerprint, and the topic whose type is meant."""


class TypeFinder:
    """Finds the class of a topic's messages, or of those of one publisher, by its fingerprint."""

    def __init__(self, module: Module, stated: Mapping[str, type[Message]] | None = None) -> None:
        """`stated`: the types of topics that win over what publishers announce."""
        self.module = module
        self._stated = stated or {}
        self._known: dict[bytes, type[Message]] = {}
        self._asking: dict[_Key, asyncio.Task[type[Message] | None]] = {}
        self._asked_at: dict[_Key, int] = {}

    def close(self) -> None:
        """Stop asking."""
        for task in list(self._asking.values()):
            task.cancel()

    # By topic

    async def find(self, topic: str) -> type[Message] | None:
        """Return the class of a topic's messages, and ask other modules for it if it is unknown here.

        None if no module answers: it takes some seconds then, and at once if they were asked just now. Raises Closed if
        the module is not open.
        """
        if (known := self.known(topic)) is not None or (fingerprint := self._announced(topic)) is None:
            return known
        answered = asyncio.Event()
        if self.ask(fingerprint, topic, answered.set):
            await answered.wait()
        return self.known(topic)

    def known(self, topic: str) -> type[Message] | None:
        """Return the class of a topic's messages as far as it is known now; None: perhaps `find` knows more."""
        if (stated := self.stated(topic)) is not None:
            return stated
        own = self.module.space.topics.get(topic)
        if own is not None and own.layout is not None:
            return own.layout.cls
        fingerprint = self._announced(topic)
        return UNANNOUNCED.get(topic) if fingerprint is None else self.by_fingerprint(fingerprint)

    def stated(self, topic: str) -> type[Message] | None:
        """Return the type that the user states."""
        return self._stated.get(topic)

    def _announced(self, topic: str) -> bytes | None:
        """Return the fingerprint that is announced for a topic, by the publishers if they announce any."""
        found = (link.discovery.topics.get(topic) for link in self.module.links)
        return next((each.fingerprint for each in found if each is not None and each.fingerprint is not None), None)

    # By fingerprint

    def by_fingerprint(self, fingerprint: bytes) -> type[Message] | None:
        """Return a class with this fingerprint that is known here."""
        if not self._known:
            classes = [*self._stated.values(), *standard_classes().values()]
            self._known = {layout(cls).fingerprint: cls for cls in reversed(classes)}
        return self._known.get(fingerprint)

    def ask(self, fingerprint: bytes, topic: str, done: Callable[[], None]) -> bool:
        """Ask other modules for a type, and call `done` when they have answered. False: they were asked just now."""
        key, now = (fingerprint, topic), self.module.space.clock.monotonic()
        task = self._asking.get(key)
        if task is None:
            if now - self._asked_at.get(key, -_ASKED_AGAIN) < _ASKED_AGAIN:
                return False
            self._note_question(key, now)
            task = self._asking[key] = asyncio.create_task(self._ask(*key), name=f"type of {topic}")
        task.add_done_callback(lambda _task: done())
        return True

    def _note_question(self, key: _Key, now: int) -> None:
        self._asked_at.pop(key, None)
        if len(self._asked_at) >= _LEARNT_MAX:
            del self._asked_at[next(iter(self._asked_at))]
        self._asked_at[key] = now

    async def _ask(self, fingerprint: bytes, topic: str) -> type[Message] | None:
        try:
            found = await self.module.network.message_type(fingerprint, topic)
        except Error:  # the module was closed meanwhile
            return None
        finally:
            del self._asking[fingerprint, topic]
        if found is not None and len(self._known) < _LEARNT_MAX:
            self._known[fingerprint] = found
        return found
