"""The type of a topic: given, written in r2p.toml, told by its publisher, or else unknown.

A peer tells the fingerprint of a layout. It is looked up among `r2p.msg` and the classes that r2p.toml names; then, on
zenoh, whoever has such a type is asked for its fields.
"""

import asyncio
import contextlib
import difflib
from collections.abc import Iterable

import r2p
from r2p.tools.run import load_module
from r2p.tools.session import Session, Settings, Usage

STANDARD = "r2p.msg"
LEARNT = "r2p.messages.schemas"
"""The module of classes that were made from what another module told."""

_ANSWERS = 1.0  # seconds that the types of a list are waited for
_AT_ONCE = 16  # that are asked for


def load_type(text: str) -> type[r2p.Message]:
    """The message class that `package.module:Class`, `FILE.py:Class`, or just a name in r2p.msg names. Raises Usage."""
    where, _, name = (text if ":" in text else f"{STANDARD}:{text}").rpartition(":")
    cls = getattr(load_module(where), name, None)
    if not (isinstance(cls, type) and issubclass(cls, r2p.Message)):
        raise Usage(f"{where} has no message class {name!r}{_similar(where, name)}")
    try:
        r2p.layout(cls)
    except r2p.MessageError as error:
        raise Usage(f"{text}: {error}") from error
    return cls


def _similar(where: str, name: str) -> str:
    classes = [key for key, value in vars(load_module(where)).items() if isinstance(value, type)]
    close = difflib.get_close_matches(name, classes, n=1)
    return f"; did you mean {where}:{close[0]}?" if close else "; write package.module:Class or FILE.py:Class"


def standard_types() -> list[type[r2p.Message]]:
    """The classes of r2p.msg; of those with the same layout the firmware's comes first."""
    module = load_module(STANDARD)
    return sorted((getattr(module, name) for name in module.__all__), key=lambda cls: str(cls.__module__))


def type_name(cls: type[r2p.Message]) -> str:
    """How `--type` names a class; just its name if another module told of it."""
    if cls.__module__ == LEARNT:
        return cls.__name__
    module = STANDARD if cls.__module__.startswith(f"{STANDARD}.") else cls.__module__
    return f"{module}:{cls.__name__}"


class Types:
    """Finds types of topics for one session."""

    def __init__(self, settings: Settings) -> None:
        self._by_topic = settings.types
        self._by_fingerprint: dict[bytes, type[r2p.Message]] | None = None
        self._learnt: dict[bytes, type[r2p.Message]] = {}

    def stated(self, topic: str, given: str | None) -> type[r2p.Message] | None:
        """The type that the user states: `given` by --type, or in r2p.toml. Raises Usage."""
        text = given or self._by_topic.get(topic)
        return None if text is None else load_type(text)

    def of(self, view: r2p.TopicView) -> type[r2p.Message] | None:
        """The type of a topic as far as it is stated or told. Raises Usage for an r2p.toml that names nothing."""
        stated = self.stated(view.name, None)
        if stated is not None or view.fingerprint is None:
            return stated
        return self.by_fingerprint(view.fingerprint) or self._learnt.get(view.fingerprint)

    async def learn(self, session: Session, view: r2p.TopicView) -> type[r2p.Message] | None:
        """As `of`; a type that is not known here is asked for on the network, where the transport can carry it."""
        known = self.of(view)
        if known is not None or view.fingerprint is None:
            return known
        found = await session.module.network.message_type(view.fingerprint)
        if found is not None:
            self._learnt[view.fingerprint] = found
        return found

    async def learn_all(self, session: Session, views: Iterable[r2p.TopicView]) -> None:
        """As `learn` for all of them, at once; who does not answer within a second is left unknown."""
        unknown = {view.fingerprint: view for view in views if view.fingerprint is not None and self.of(view) is None}
        room = asyncio.Semaphore(_AT_ONCE)

        async def learn(view: r2p.TopicView) -> None:
            async with room:
                await self.learn(session, view)

        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_ANSWERS), asyncio.TaskGroup() as tasks:
                for view in unknown.values():
                    tasks.create_task(learn(view))

    def by_fingerprint(self, fingerprint: bytes) -> type[r2p.Message] | None:
        """The known class of that layout."""
        if self._by_fingerprint is None:
            known = [*standard_types(), *map(load_type, self._by_topic.values())]
            self._by_fingerprint = {r2p.layout(cls).fingerprint: cls for cls in reversed(known)}
        return self._by_fingerprint.get(fingerprint)


def of_size(size: int) -> list[str]:
    """The standard types of so many bytes."""
    return [type_name(cls) for cls in standard_types() if r2p.layout(cls).size == size]


def suggestion(size: int) -> str:
    """Which types it might be, for the end of a sentence."""
    names = of_size(size)
    return f"; of {size} bytes are {', '.join(names)}" if names else ""


def complete_type(incomplete: str) -> list[str]:
    """Completions for --type."""
    return [name for name in map(type_name, standard_types()) if name.startswith(incomplete)]


async def find(session: Session, topic: str, given: str | None) -> type[r2p.Message]:
    """The type to publish a topic with: stated, or told by who subscribes it. Raises Usage if it can't be known."""
    types = Types(session.settings)
    stated = types.stated(topic, given)
    if stated is not None:
        return stated
    await session.settle()
    view = session.module.network.topics().get(topic, r2p.TopicView(topic))
    found = await types.learn(session, view)
    if found is None:
        size = f" ({view.size} bytes; of that size: {', '.join(of_size(view.size)) or 'none in r2p.msg'})" * bool(
            view.size
        )
        raise Usage(f"the type of {topic} is unknown{size}: give --type package.module:Class")
    return found
