"""Which message class each topic has on a link to ROS.

The first of these counts: the class of a publisher or subscriber of this module; the one that the user states
(`RosOptions.types`); on a gateway, that of publishers or subscribers on its other links, which are asked for its name
and fields by the fingerprint that they announce; and where nobody here knows the type, that of the ROS nodes.
"""

import asyncio  # noqa: TC003 - the others are imported for good, too
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Sequence

from r2p.clock import sleep_in_background
from r2p.codecs.management import ANY_TYPE
from r2p.errors import MessageError
from r2p.messages import Message, layout
from r2p.protocols.discovery.directory import TABLE_MAX
from r2p.protocols.discovery.events import TopicType
from r2p.ros.action_types import with_names
from r2p.ros.background import BackgroundResults
from r2p.ros.classes import standard_classes
from r2p.ros.definitions import TEXT_MAX
from r2p.ros.middleware import RosPeerEndpoint
from r2p.ros.topics import TopicTypes, ros_class, ros_type
from r2p.transports.link import Hub

_PEERS_MAX = 64  # publishers and subscribers of one topic whose types are looked at: a flood has one for each
_TRIES = 12

_DEFINITIONS_MAX = 32 << 20  # characters of definitions that are kept; those of all types of a robot are a million

_TRY_AGAIN_S = 5.0
"""Seconds after which modules are asked once more for a type that none of them gave."""

AskRosNode = Callable[[RosPeerEndpoint], Awaitable[str]]
"""Asks a ROS node for the definition of its type."""


class TopicClasses:
    """The classes of topics; `changed(topic)` is called when one was learnt."""

    def __init__(
        self,
        hub: Hub,
        types: TopicTypes,
        background: BackgroundResults,
        ask_ros_node: AskRosNode,
        changed: Callable[[str], None],
    ) -> None:
        self._space = hub.space
        self._types = types
        self._background = background
        self._ask_modules = hub.message_type
        self._ask_ros_node = ask_ros_node
        self._changed = changed
        self._known: dict[str, type[Message]] = {}
        """The class that each topic had last."""
        self._learnt: dict[tuple[str, bytes], type[Message]] = {}
        self._definitions: dict[tuple[str, str], str] = {}
        """Definitions of ROS nodes, by name and checksum of their types."""
        self._definitions_size = 0
        """Characters that were added to them since they were empty."""
        self._tasks: dict[object, asyncio.Task[None]] = {}

    def close(self) -> None:
        """Stop asking."""
        for task in self._tasks.values():
            task.cancel()

    @property
    def known(self) -> Iterable[type[Message]]:
        """The classes that were found."""
        return self._known.values()

    def find(
        self, topic: str, elsewhere: tuple[TopicType, TopicType], peers: Sequence[RosPeerEndpoint]
    ) -> type[Message] | None:
        """Return the class of a topic that is used here; None if it is unknown, or being asked for.

        `elsewhere` are the types in which it is published and subscribed on a gateway's other links; `peers` are the
        publishers and subscribers of other ROS nodes.
        """
        found = self._local(topic) or self._types.stated(topic) or self._elsewhere(topic, elsewhere, peers)
        if found is not None:
            self._remember(topic, found)
        return found

    def of_peers(self, topic: str, peers: Sequence[RosPeerEndpoint]) -> type[Message] | None:
        """Return the class of the type that ROS nodes have for a topic, the first of several; None if it is unknown."""
        for peer in peers[:_PEERS_MAX]:
            found = self._of_peer(topic, peer) if peer.type else None
            if found is not None:
                self._remember(topic, found)
                return found
        return None

    def add_definition(self, type_name: str, checksum: str, definition: str) -> None:
        """Enter the definition of a ROS node's type."""
        if 0 < len(definition) <= TEXT_MAX:
            self._definitions_size += len(definition)
            if len(self._definitions) >= TABLE_MAX or self._definitions_size > _DEFINITIONS_MAX:
                self._definitions.clear()
                self._definitions_size = len(definition)
            self._definitions[type_name, checksum] = self._definitions[type_name, ""] = definition

    def _remember(self, topic: str, cls: type[Message]) -> None:
        if len(self._known) >= 2 * TABLE_MAX:
            self._known.clear()
        self._known[topic] = cls

    def _local(self, topic: str) -> type[Message] | None:
        known = self._space.topics.get(topic)
        if known is None:
            return None
        if known.layout is not None:
            return known.layout.cls
        return known.accepted[0].layouts[0].cls if known.accepted else None

    def _elsewhere(
        self, topic: str, elsewhere: tuple[TopicType, TopicType], peers: Sequence[RosPeerEndpoint]
    ) -> type[Message] | None:
        announced = [each for each in elsewhere if each != TopicType()]
        if not announced:
            return self.of_peers(topic, peers)
        fingerprint = next((each.fingerprint for each in announced if each.fingerprint != ANY_TYPE), None)
        if fingerprint is None:  # firmware, which names no types: another type of this size may mean something else
            return None
        found = self._learnt.get((topic, fingerprint))
        if found is None:
            of_ros = self.of_peers(topic, peers)
            if of_ros is not None and layout(of_ros).fingerprint == fingerprint:
                return of_ros  # it was learnt from this link
            self._start((topic, fingerprint), self._learn, topic, fingerprint)
        return found

    async def _learn(self, topic: str, fingerprint: bytes) -> None:
        for _ in range(_TRIES):
            found = await self._ask_modules(fingerprint, topic)
            if found is not None:
                if len(self._learnt) >= TABLE_MAX:
                    self._learnt.clear()
                self._learnt[topic, fingerprint] = _standard(found)
                self._changed(topic)
                return
            await sleep_in_background(_TRY_AGAIN_S)
        del self._tasks[topic, fingerprint]  # the next change of the topic begins anew

    # Of ROS nodes

    def _of_peer(self, topic: str, peer: RosPeerEndpoint) -> type[Message] | None:
        given = self._definitions.get((peer.type, peer.checksum), "")
        try:
            key = peer.type, peer.checksum, hash(given)  # the text itself may be long
            found = self._background.get(topic, key, lambda: self._make(peer.type, peer.checksum, given))
        except MessageError:
            if not given:
                self._start((peer.node, peer.type, peer.checksum), self._describe, topic, peer)
            return None
        return found

    def _make(self, type_name: str, checksum: str, definition: str) -> type[Message]:
        """Return the class of a ROS node's type; without its definition, of that which comes with ROS."""
        made = ros_class(type_name, self._types.version, definition)
        layout(made)
        if not definition and checksum not in ("", ros_type(made, self._types.version).checksum):
            raise MessageError(f"{type_name} has another definition here")
        return made

    async def _describe(self, topic: str, peer: RosPeerEndpoint) -> None:
        definition = await self._ask_ros_node(peer)
        if definition:
            self.add_definition(peer.type, peer.checksum, definition)
            self._changed(topic)

    def _start(self, key: object, ask: Callable[..., Coroutine[None, None, None]], *args: object) -> None:
        """Ask, unless that was begun before."""
        if key in self._tasks:
            return
        if len(self._tasks) >= TABLE_MAX:
            self._tasks = {key: task for key, task in self._tasks.items() if not task.done()}
        if len(self._tasks) < TABLE_MAX:
            self._tasks[key] = self._space.loop.create_task(ask(*args))


def _standard(cls: type[Message]) -> type[Message]:
    """Return the class of r2p.msg with this name and these fields, if there is one: its nested types have names."""
    known = standard_classes().get(layout(cls).name)
    return known if known is not None and layout(known).schema == layout(cls).schema else with_names(cls)
