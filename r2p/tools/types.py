"""The type of a topic: from the command line, from r2p.toml, from a peer, or unknown.

A peer announces the fingerprint of a layout. It is looked up in `r2p.msg` and in the classes that r2p.toml names; then,
on zenoh, modules that have such a type are queried for its fields.

Types are shown by their full names, `package/Name`, which `--type` takes wherever the class is known. Several names may
have one layout, `std_msgs/Float32` and `r2p_msgs/Float32`: of a topic on ROS, the name is that which it has there.
"""

import asyncio
import contextlib
import difflib
from collections.abc import Callable, Iterable
from typing import Any

import r2p
from r2p.codecs.management import decode_size, encode_size
from r2p.messages import SIZE_MAX
from r2p.messages.layouts import fingerprint_of_class, full_name
from r2p.services.definition import Definition, define
from r2p.tools.output import Output
from r2p.tools.run import load_module
from r2p.tools.session import Session, Settings, UsageError, wait_until

STANDARD = "r2p.msg"
LEARNT = "r2p.messages.schemas"
"""The `__module__` of classes that were made from the fields of another module's type."""

SIZE_CUT, _ = decode_size(encode_size(SIZE_MAX, varies=True))
"""The size that management messages give for all messages of variable length that may have more bytes."""

_ANSWERS = 1.0  # seconds to wait for the types of a list
_ANNOUNCED = 2.0  # seconds to wait for a topic that others have not announced with the rest
_AT_ONCE = 16  # queries


def load_type(text: str, others: Iterable[type[r2p.Message]] = ()) -> type[r2p.Message]:
    """Return the message class of `package.module:Class`, `FILE.py:Class`, or a name of a type. Raises UsageError.

    A name is one in r2p.msg (`LaserScan`), or the full one (`sensor_msgs/LaserScan`, also as ROS 2 writes it, with
    `/msg/`) of a class there or of `others`, or of a type that comes with ROS (extra `ros`).
    """
    if "/" in text and ":" not in text:
        return _by_full_name(text, [*standard_types(), *others])
    where, _, name = (text if ":" in text else f"{STANDARD}:{text}").rpartition(":")
    cls = getattr(load_module(where), name, None)
    if not (isinstance(cls, type) and issubclass(cls, r2p.Message)):
        raise UsageError(f"{where} has no message class {name!r}{_similar(where, name)}")
    try:
        r2p.layout(cls)
    except r2p.MessageError as error:
        raise UsageError(f"{text}: {error}") from error
    return cls


def _by_full_name(text: str, known: list[type[r2p.Message]]) -> type[r2p.Message]:
    by_name = {full_name(cls): cls for cls in reversed(known)}
    found = by_name.get(text.replace("/msg/", "/")) or _of_ros(text)
    if found is None:
        close = difflib.get_close_matches(text, by_name, n=1)
        advice = f"did you mean {close[0]}?" if close else "write package.module:Class or FILE.py:Class"
        raise UsageError(f"neither r2p.msg nor [types] of r2p.toml has a type {text}; {advice}")
    return found


def _of_ros(text: str) -> type[r2p.Message] | None:
    """Return the class of a type that comes with ROS 2, or else with ROS 1; None without one, or without rosbags."""
    from r2p.ros.topics import ros_class  # only here: it takes a tenth of a second

    for version in (2, 1):
        with contextlib.suppress(r2p.MessageError):
            return ros_class(text, version)
    return None


def load_service(name: str, text: str) -> Definition[Any, Any]:
    """Return the service of `package.module:Class`, a subclass of r2p.Service, or of two types with a comma between.

    Raises UsageError.
    """
    try:
        if "," in text:
            request, response = text.split(",", 1)
            return define(name, load_type(request.strip()), load_type(response.strip()))
        service = _find_service(text)
        if service is None:
            where = text.rpartition(":")[0] or STANDARD
            raise UsageError(
                f"{text} is not a service: {where} has no class {text.rpartition(':')[2]!r} with classes "
                "Request and Response; or give two types of messages with a comma"
            )
        return define(name, service)
    except r2p.MessageError as error:
        raise UsageError(f"{text}: {error}") from error


def load_interface(text: str) -> tuple[str, list[type[r2p.Message]]] | None:
    """Return the name in ROS 2 and the classes of the parts of a service or an action; None for another text.

    Raises UsageError.
    """
    if ":" not in text:
        return None
    where, _, name = text.rpartition(":")
    found = getattr(load_module(where), name, None)
    try:
        if hasattr(found, "Goal"):
            from r2p.ros.action_types import action_types  # only here, as it takes a while

            types = action_types(found)
            return types.name.replace("/", "/action/"), [types.goal, types.result, types.feedback]
        if hasattr(found, "Request") and hasattr(found, "Response"):
            from r2p.ros.service_types import service_shape
            from r2p.ros.type_names import ros2_name

            definition = define("service", found)
            shape = service_shape(definition.requests, definition.responses)
            return ros2_name(shape.name, "srv"), [definition.request.cls, definition.response.cls]
    except r2p.MessageError as error:
        raise UsageError(f"{text}: {error}") from error
    return None


def _find_service(text: str) -> Any:
    """Return the class with nested classes Request and Response, if the text names one."""
    if text.startswith("std_srvs/"):
        text = f"r2p.ros.std_srvs:{text.rpartition('/')[2]}"
    where, _, name = (text if ":" in text else f"{STANDARD}:{text}").rpartition(":")
    found = getattr(load_module(where), name, None)
    return found if hasattr(found, "Request") and hasattr(found, "Response") else None


def is_service(text: str) -> bool:
    """Return whether a text names the types of a service, not of a message."""
    return "," in text or _find_service(text) is not None


def _load_all(text: str) -> list[type[r2p.Message]]:
    """Return the types of topics that an entry of [types] names: one type, or the two of a service."""
    if is_service(text):
        definition = load_service("service", text)
        return [definition.requests.cls, definition.responses.cls]
    return [load_type(text)]


def _similar(where: str, name: str) -> str:
    values = vars(load_module(where)).items()
    classes = [key for key, value in values if isinstance(value, type) and issubclass(value, r2p.Message)]
    close = difflib.get_close_matches(name, classes, n=1)
    return f"; did you mean {where}:{close[0]}?" if close else "; write package.module:Class or FILE.py:Class"


def standard_types() -> list[type[r2p.Message]]:
    """Return the classes of r2p.msg in their order; of those with the same layout, the firmware's comes first."""
    found = vars(load_module(STANDARD)).values()
    return [each for each in found if isinstance(each, type) and r2p.Message in each.__bases__]


def type_name(cls: type[r2p.Message]) -> str:
    """Return the full name of a class; the bare one of a class that was learnt without."""
    name = full_name(cls)
    return cls.__name__ if cls.__module__ == LEARNT and name.startswith("r2p_msgs/") else name


def class_path(cls: type[r2p.Message]) -> str:
    """Return where the class of a type is, `package.module:Class`; empty for one that was learnt."""
    if cls.__module__ == LEARNT:
        return ""
    if vars(load_module(STANDARD)).get(cls.__name__) is cls:  # its own module may be a private one
        return f"{STANDARD}:{cls.__name__}"
    return f"{cls.__module__}:{cls.__name__}"


def size_text(size: int, *, varies: bool) -> str:
    """Return the size of the messages of a type, in words: "8 bytes", "up to 131 380 bytes"."""
    text = f"{size:,}".replace(",", " ") + f" byte{'' if size == 1 else 's'}"
    if varies and size == SIZE_CUT:
        return f"{text} or more"
    return f"up to {text}" if varies else text


async def put_sizes(output: Output, rows: list[dict[str, Any]], columns: list[str]) -> None:
    """Print a table with the columns `size` and `varies`; at a terminal `varies` is a word before the size."""
    if output.format == "text":
        columns = [name for name in columns if name != "varies"]
        rows = [row | {"size": f"up to {row['size']}"} if row["varies"] else row for row in rows]
    await output.table(rows, columns)


class Types:
    """Finds the types of topics, and remembers those that it has learnt."""

    def __init__(self, settings: Settings) -> None:
        self._by_topic = settings.types
        self._by_fingerprint: dict[bytes, type[r2p.Message]] | None = None
        self._learnt: dict[bytes, type[r2p.Message]] = {}

    @property
    def named(self) -> list[type[r2p.Message]]:
        """The classes that r2p.toml names. Raises UsageError."""
        return [cls for topic in self._by_topic for cls in self._load_named(topic)]

    def load(self, text: str) -> type[r2p.Message]:
        """Return the class that the user names. Raises UsageError."""
        return load_type(text, self.named if "/" in text and ":" not in text else ())

    def _load_named(self, topic: str) -> list[type[r2p.Message]]:
        try:
            return _load_all(self._by_topic[topic])
        except UsageError as error:
            raise UsageError(f"[types] {topic}: {error}") from error

    def stated(self, topic: str, given: str | None) -> type[r2p.Message] | None:
        """Return the type that the user states: `given` by --type, or in r2p.toml. Raises UsageError."""
        if given:
            return self.load(given)
        found = self._load_named(topic) if topic in self._by_topic else []
        return found[0] if len(found) == 1 else None

    def stated_topics(self) -> dict[str, type[r2p.Message]]:
        """Return the types of topics that r2p.toml states, and of services those of both topics. Raises UsageError."""
        found: dict[str, type[r2p.Message]] = {}
        for name, text in self._by_topic.items():
            if is_service(text):
                service = load_service(name, text)
                found |= {service.request_topic: service.requests.cls, service.response_topic: service.responses.cls}
            else:
                found[name], *_ = self._load_named(name)
        return found

    def stated_service(self, name: str, given: str | None) -> Definition[Any, Any] | None:
        """Return the types of a service that the user states: `given` by --type, or in r2p.toml. Raises UsageError."""
        text = given or self._by_topic.get(name)
        return None if text is None else load_service(name, text)

    def of(self, view: r2p.TopicView) -> type[r2p.Message] | None:
        """Return the type of a topic if it is stated or known. Raises UsageError for an invalid name in r2p.toml."""
        stated = self.stated(view.name, None)
        if stated is not None or view.fingerprint is None:
            return stated
        return self.by_fingerprint(view.fingerprint) or self._learnt.get(view.fingerprint)

    def describe(self, view: r2p.TopicView) -> dict[str, Any]:
        """Return name, type and size of a topic as a record; None is what is unknown.

        Where the length of its messages `varies`, the size is that of the longest one. ROS nodes that have the topic
        decide what its type is called.
        """
        cls = self.of(view)
        size = view.size or (0 if view.varies else None)
        if view.varies and view.size == SIZE_CUT and cls is not None:
            size = max(SIZE_CUT, r2p.layout(cls).size)
        name = view.ros_type or (None if cls is None else type_name(cls))
        return {"topic": view.name, "type": name, "size": size, "varies": view.varies}

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
            known = [*standard_types(), *self.named]
            self._by_fingerprint = {fingerprint_of_class(cls): cls for cls in reversed(known)}
        return self._by_fingerprint.get(fingerprint)


def of_size(size: int) -> list[str]:
    """Return the names of the standard types whose messages all have this size in bytes."""
    return [type_name(cls) for cls in standard_types() if size and r2p.layout(cls).exact_size == size]


def suggestion(size: int) -> str:
    """Return the standard types of this size, for the end of a sentence."""
    names = of_size(size)
    return f"; types of {size} bytes: {', '.join(names)}" if names else ""


def describe_other(
    settings: Settings, what: str, cls: type[r2p.Message], size: int, fingerprint: bytes, *, varies: bool
) -> str:
    """Say that a topic (`what`: with a verb) has another type than `cls`, and which to give."""
    known, own, name = Types(settings).by_fingerprint(fingerprint), r2p.layout(cls), type_name(cls)
    exact, shown = 0 if varies else size, size_text(size, varies=varies)
    if known is not None:
        own_size = size_text(own.size, varies=own.varies)
        return f"{what} {type_name(known)} ({shown}), not {name} ({own_size}): give --type {type_name(known)}"
    if varies and own.varies:
        return f"{what} another type of variable length than {name}: give the right --type, or none"
    if exact == own.exact_size:
        return f"{what} another type of {shown} than {name}: give the right --type, or none"
    has = "messages of variable length" if own.varies else f"{own.size}"
    return f"{what} messages of {shown}, but {name} has {has}: give the right --type{suggestion(exact)}"


async def announced(session: Session, topic: str, enough: Callable[[r2p.TopicView], bool]) -> r2p.TopicView:
    """Return what is announced of a topic; wait a little for it, because a busy gateway announces late and in parts."""

    def view() -> r2p.TopicView:
        return session.module.network.topics().get(topic, r2p.TopicView(topic))

    if session.settings.via:
        with session.waiting(f"the type of {topic}"):
            await wait_until(lambda: enough(view()), _ANNOUNCED)
    return view()


async def find(session: Session, topic: str, given: str | None) -> type[r2p.Message]:
    """Return the type to publish a topic with: stated, or a subscriber's. Raises UsageError if it is unknown."""
    types = Types(session.settings)
    stated = types.stated(topic, given)
    if stated is not None:
        return stated
    await session.settle()
    view = await announced(session, topic, lambda view: view.size > 0 or view.varies)
    found = await types.learn(session, view)
    if found is None:
        exact = 0 if view.varies else view.size
        names = ", ".join(of_size(exact)) or "none in r2p.msg"
        size = f" ({exact} bytes; types of this size: {names})" if exact else ""
        raise UsageError(f"the type of {topic} is unknown{size}: give --type package.module:Class")
    return found
