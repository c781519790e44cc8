"""The type of a topic: from the command line, from r2p.toml, from a peer, or unknown.

A peer announces the fingerprint of a layout. It is looked up in `r2p.msg` and in the classes that r2p.toml names; then,
on zenoh, modules that have such a type are queried for its fields.
"""

import asyncio
import contextlib
import difflib
from collections.abc import Iterable
from typing import Any

import r2p
from r2p.tools.run import load_module
from r2p.tools.session import Session, Settings, UsageError, wait_until

STANDARD = "r2p.msg"
LEARNT = "r2p.messages.schemas"
"""The `__module__` of classes that were made from the fields of another module's type."""

_ANSWERS = 1.0  # seconds to wait for the types of a list
_ANNOUNCED = 2.0  # seconds to wait for a topic that others have not announced with the rest
_AT_ONCE = 16  # queries


def load_type(text: str) -> type[r2p.Message]:
    """Return the message class of `package.module:Class`, `FILE.py:Class`, or a name in r2p.msg. Raises UsageError."""
    where, _, name = (text if ":" in text else f"{STANDARD}:{text}").rpartition(":")
    cls = getattr(load_module(where), name, None)
    if not (isinstance(cls, type) and issubclass(cls, r2p.Message)):
        raise UsageError(f"{where} has no message class {name!r}{_similar(where, name)}")
    try:
        r2p.layout(cls)
    except r2p.MessageError as error:
        raise UsageError(f"{text}: {error}") from error
    return cls


def _similar(where: str, name: str) -> str:
    classes = [key for key, value in vars(load_module(where)).items() if isinstance(value, type)]
    close = difflib.get_close_matches(name, classes, n=1)
    return f"; did you mean {where}:{close[0]}?" if close else "; write package.module:Class or FILE.py:Class"


def standard_types() -> list[type[r2p.Message]]:
    """Return the classes of r2p.msg in their order; of those with the same layout, the firmware's comes first."""
    found = vars(load_module(STANDARD)).values()
    return [each for each in found if isinstance(each, type) and r2p.Message in each.__bases__]


def type_name(cls: type[r2p.Message]) -> str:
    """Return the name of a class for `--type`; only its bare name if it was learnt from another module."""
    if cls.__module__ == LEARNT:
        return cls.__name__
    if vars(load_module(STANDARD)).get(cls.__name__) is cls:  # its own module may be a private one
        return f"{STANDARD}:{cls.__name__}"
    return f"{cls.__module__}:{cls.__name__}"


class Types:
    """Finds the types of topics, and remembers those that it has learnt."""

    def __init__(self, settings: Settings) -> None:
        self._by_topic = settings.types
        self._by_fingerprint: dict[bytes, type[r2p.Message]] | None = None
        self._learnt: dict[bytes, type[r2p.Message]] = {}

    def stated(self, topic: str, given: str | None) -> type[r2p.Message] | None:
        """Return the type that the user states: `given` by --type, or in r2p.toml. Raises UsageError."""
        if given:
            return load_type(given)
        try:
            return load_type(self._by_topic[topic]) if topic in self._by_topic else None
        except UsageError as error:
            raise UsageError(f"[types] {topic}: {error}") from error

    def of(self, view: r2p.TopicView) -> type[r2p.Message] | None:
        """Return the type of a topic if it is stated or known. Raises UsageError for an invalid name in r2p.toml."""
        stated = self.stated(view.name, None)
        if stated is not None or view.fingerprint is None:
            return stated
        return self.by_fingerprint(view.fingerprint) or self._learnt.get(view.fingerprint)

    def describe(self, view: r2p.TopicView) -> dict[str, Any]:
        """Return name, type and size of a topic as a record; None is what is unknown."""
        cls = self.of(view)
        return {"topic": view.name, "type": None if cls is None else type_name(cls), "size": view.size or None}

    async def learn(self, session: Session, view: r2p.TopicView) -> type[r2p.Message] | None:
        """Return the type of a topic, and query the network for an unknown one, if the transport carries types."""
        known = self.of(view)
        if known is not None or view.fingerprint is None:
            return known
        found = await session.module.network.message_type(view.fingerprint)
        if found is not None:
            self._learnt[view.fingerprint] = found
        return found

    async def learn_all(self, session: Session, views: Iterable[r2p.TopicView]) -> None:
        """Learn the types of all these topics, concurrently; without an answer in a second they stay unknown."""
        unknown = {view.fingerprint: view for view in views if view.fingerprint is not None and self.of(view) is None}
        limit = asyncio.Semaphore(_AT_ONCE)

        async def learn(view: r2p.TopicView) -> None:
            async with limit:
                await self.learn(session, view)

        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_ANSWERS), asyncio.TaskGroup() as tasks:
                for view in unknown.values():
                    tasks.create_task(learn(view))

    def by_fingerprint(self, fingerprint: bytes) -> type[r2p.Message] | None:
        """Return the known class of a layout."""
        if self._by_fingerprint is None:
            known = [*standard_types(), *map(load_type, self._by_topic.values())]
            self._by_fingerprint = {r2p.layout(cls).fingerprint: cls for cls in reversed(known)}
        return self._by_fingerprint.get(fingerprint)


def of_size(size: int) -> list[str]:
    """Return the names of the standard types of this size in bytes."""
    return [type_name(cls) for cls in standard_types() if r2p.layout(cls).size == size]


def suggestion(size: int) -> str:
    """Return the standard types of this size, for the end of a sentence."""
    names = of_size(size)
    return f"; types of {size} bytes: {', '.join(names)}" if names else ""


def describe_other(settings: Settings, what: str, cls: type[r2p.Message], size: int, fingerprint: bytes) -> str:
    """Say that a topic (`what`: with a verb) has another type than `cls`, and which to give."""
    known, own, name = Types(settings).by_fingerprint(fingerprint), r2p.layout(cls).size, type_name(cls)
    if known is not None:
        return f"{what} {type_name(known)} ({size} bytes), not {name} ({own} bytes): give --type {type_name(known)}"
    if size == own:
        return f"{what} another type of {size} bytes than {name}: give the right --type, or none"
    return f"{what} messages of {size} bytes, but {name} has {own}: give the right --type{suggestion(size)}"


def complete_type(incomplete: str) -> list[str]:
    """Completions for --type: bare names, because a colon begins a new word in bash."""
    names = [cls.__name__ for cls in standard_types()]
    if ":" in incomplete:
        names = [f"{STANDARD}:{name}" for name in names]
    return [name for name in names if name.startswith(incomplete)]


async def _announced(session: Session, topic: str) -> r2p.TopicView:
    """Return what is announced of a topic; wait a little for it, because a busy gateway answers late and in parts."""

    def view() -> r2p.TopicView:
        return session.module.network.topics().get(topic, r2p.TopicView(topic))

    if session.settings.via:
        with session.waiting(f"the type of {topic}"):
            await wait_until(lambda: view().size > 0, _ANNOUNCED)
    return view()


async def find(session: Session, topic: str, given: str | None) -> type[r2p.Message]:
    """Return the type to publish a topic with: stated, or a subscriber's. Raises UsageError if it is unknown."""
    types = Types(session.settings)
    stated = types.stated(topic, given)
    if stated is not None:
        return stated
    await session.settle()
    view = await _announced(session, topic)
    found = await types.learn(session, view)
    if found is None:
        names = ", ".join(of_size(view.size)) or "none in r2p.msg"
        size = f" ({view.size} bytes; types of this size: {names})" if view.size else ""
        raise UsageError(f"the type of {topic} is unknown{size}: give --type package.module:Class")
    return found
