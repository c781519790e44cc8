"""A module that is not a gateway, with several links: it uses each topic on one of those that gateways join.

Which links are used is up to `r2p.protocols.bridge.link_selection`. A link that is not used for a topic announces
NOTHING of it; others see the module's nodes there as gateways pass them on. A topic that a link can't carry, as its
name or its messages are too long, takes the next link that can.
"""

from collections.abc import Callable

from r2p.clock import Alarm
from r2p.codecs import UnknownType, management, probes
from r2p.codecs.management import ManagementType
from r2p.errors import DecodeError
from r2p.protocols.bridge.link_selection import LinkSelection
from r2p.protocols.discovery.events import TopicType
from r2p.runtime.sample import Source
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.announcement import NOTHING, Announcement, GatewayHooks
from r2p.transports.link import Link
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error

_PROBE = ord("_")
"""The first byte of an ALIVE that is a probe."""
_ALL: frozenset[int] = frozenset()
"""Topics that all links can carry."""


class MultihomedModule:
    """The links of one module. `notify(link, kind, text, trouble)` is called with news for the user.

    `sole_transport`: there will be no other links than those of the transport that attaches the first one.
    """

    def __init__(
        self,
        space: TopicSpace,
        instance: int,
        notify: Callable[[Link, str, str, bool], None],
        *,
        sole_transport: bool = False,
    ) -> None:
        self.selection = LinkSelection(instance)
        self._space = space
        self._instance = instance
        self._own_instance = instance.to_bytes(4, "little")
        self._own_name = space.module.encode()
        self._notify = notify
        self._sole_transport = sole_transport
        self._ports: dict[str, _MultihomedPort] = {}
        """Ports by the name of the link."""
        self._by_number: dict[int, _MultihomedPort] = {}
        self._attached = 0
        self._changes = 0
        self._used = {_ALL: self.selection.used(0, _ALL)}
        """The links that are used, by those that can't carry a topic."""
        self._without: dict[str, frozenset[int]] = {}
        """The links that can't carry a topic, by its name, as they were when it was announced last."""
        self._unable: dict[tuple[int, int, bool], frozenset[int]] = {}
        """The links that can't carry a topic, by the length of its name, its messages' size, and if that varies."""
        self._filtering = False
        self._alarm = Alarm(space.loop, self._poll, background=True)

    # Links

    def attach(self, link: Link) -> None:
        """Add a link, up or not yet; those that come first are preferred."""
        self._attached += 1
        port = _MultihomedPort(self, link, self._attached)
        self._ports[link.name] = self._by_number[port.number] = port
        self._unable.clear()
        link.gateway_hooks = port
        self._announce_sole_link()

    def detach(self, link: Link) -> None:
        """Remove a link that the module no longer has."""
        port = self._ports.pop(link.name)
        del self._by_number[port.number]
        self._unable.clear()
        self.selection.close(self._now(), port.number)
        self.selection.forget(port.number)
        self._announce_sole_link()
        self._act()

    def link_changed(self, link: Link) -> None:
        """Follow a link that went up or down."""
        port = self._ports.get(link.name)
        if port is None:
            return
        if link.up:
            self.selection.open(self._now(), port.number, lone=link.point_to_point)
        else:
            self.selection.close(self._now(), port.number)
            link.stands_by = ""
        self._act()  # which announces topics on links whose use has changed
        if link.up and port.number not in self._used[_ALL]:
            self._announce(list(self._space.topics.values()), [link])

    def close(self) -> None:
        """Stop, as the module ends."""
        self._alarm.close()

    def _announce_sole_link(self) -> None:
        """Let a gateway at the other end of the only line forward at once: messages can't come by another way, too."""
        sole = self._sole_transport and len(self._ports) == 1
        for port in self._ports.values():
            port.link.discovery.announce_sole_link(sole=sole and port.link.point_to_point)

    # Received messages

    def handle_management(self, port: "_MultihomedPort", data: bytes) -> bool:
        """Handle a management message; return True if discovery need not see it."""
        if not self._may_concern_links(data):
            return False
        try:
            message = management.decode(data)
        except (DecodeError, UnknownType):
            return False
        is_for_us = self._select(self._now(), port.number, message, data)
        if is_for_us:
            self._act()
        return is_for_us

    def _may_concern_links(self, data: bytes) -> bool:
        """Return whether a message may say something about the links; hardly any does, and all are asked."""
        kind = management.type_of(data)
        if kind == ManagementType.ALIVE:
            return data[0] == _PROBE or self._own_name in data
        if kind == ManagementType.HELLO:
            return self._own_instance in data
        return kind in management.GATEWAY_TYPES

    def _select(self, now: int, number: int, message: management.Management, data: bytes) -> bool:
        """Enter what a message shows about the links; return False for a message about something else."""
        match message:
            case management.Bridge():
                self.selection.receive_bridge(now, number, message)
            case management.Leaf(self._instance):
                self.selection.receive_leaf(now, number, message)
            case management.Hello(_, self._instance, hops=0) | management.Alive(self._space.module):
                return self.selection.receive_own(now, number)
            case management.Alive() if (probe := probes.decode(data)) is not None and probe[0] == self._instance:
                self.selection.receive_probe(now, number, probe[1])
            case management.Leaf() | management.Mesh():
                pass
            case _:
                return False
        return True

    def discovery_changed(self, port: "_MultihomedPort") -> None:
        """Check whether discovery has found the module at the other end, or the size of a topic's messages."""
        if port.link.point_to_point and port.link.discovery.generation != port.generation:
            port.generation = port.link.discovery.generation
            self.selection.set_remote(self._now(), port.number, port.link.discovery.sole_peer)
            self._act()
        if len(self._used[_ALL]) == len(self.selection.by_number):
            return
        resized = [
            topic
            for topic in self._space.topics.values()
            if topic.layout is None
            and not topic.unused
            and self._without.get(topic.name, _ALL) != self._unable_for(topic)
        ]
        self._announce(resized, [each.link for each in self._by_number.values() if each.link.up])

    # Topics

    def review_use(self, topic: Topic, port: "_MultihomedPort") -> bool:
        """Decide whether the topic uses this link; a link that is down keeps its topics until it is up again."""
        if port.number not in self.selection.by_number:
            return True
        without = self._unable_for(topic)
        if topic.unused:
            self._without.pop(topic.name, None)
        else:
            self._without[topic.name] = without
        topic.drop_filter = self._drop_filter(topic) if self._filtering else None
        if port.number in without and not self._size_of(topic)[1]:
            return True  # the link refuses the topic itself
        return port.number in self.selection.used(self._now(), without)

    def _unable_for(self, topic: Topic) -> frozenset[int]:
        """Return the links that can't carry the topic.

        If the length of its messages varies, and no link carries the longest ones, those that carry the most are able.
        """
        size, varies = self._size_of(topic)
        key = len(topic.name), size, varies
        if key not in self._unable:
            links = {number: port.link for number, port in self._by_number.items()}
            if varies:
                named = [link for link in links.values() if len(topic.name) <= link.max_name]
                size = min(size, max((link.longest(varies=True) for link in named), default=size))
            unable = (number for number, link in links.items() if _cannot_carry(link, len(topic.name), size, varies))
            self._unable[key] = frozenset(unable)
        return self._unable[key]

    def _size_of(self, topic: Topic) -> tuple[int, bool]:
        """Return the bytes of a topic's messages (0: not known); at most so many, if the second one is true."""
        if topic.layout is not None:
            return topic.layout.size, topic.layout.varies
        infos = [port.link.discovery.topics.get(topic.name) for port in self._by_number.values()]
        return max(((info.size, info.varies) for info in infos if info is not None), default=(0, False))

    def _drop_filter(self, topic: Topic) -> Callable[[str], bool]:
        """Return a predicate for names of links: True if messages from that link are dropped.

        It is asked before each message while gateways consent to the use of several links for a while only: a module
        that was stopped must not go on with them.
        """

        def drops(link: str) -> bool:
            if self._now() >= self.selection.consent_until:
                self._poll()
            port = self._ports.get(link)
            return port is not None and not self.review_use(topic, port)

        return drops

    # Consequences

    def _now(self) -> int:
        return self._space.clock.monotonic()

    def _poll(self) -> None:
        try:
            self.selection.poll(self._now())
            self._act()
        except Exception as error:  # noqa: BLE001 - counted and logged
            count_internal_error((port.link.stats.lost for port in self._ports.values()), error)
            self._alarm.set(self._now() + RETRY_AFTER_ERROR)

    def _act(self) -> None:
        for number, message in self.selection.pop_messages():
            link = self._by_number[number].link
            if link.up and message is not None:
                link.send_management(management.encode(message), urgent=True)
            elif link.up and link.passes_probes:
                link.write_management(probes.encode(self._instance, number))
        filtering = self.selection.needs_consent
        if self.selection.changes != self._changes or filtering != self._filtering:
            self._changes = self.selection.changes
            self._filtering = filtering
            self._choose()
        for number in self._by_number.keys() - self._used[_ALL]:
            self._report_unused(number, self._by_number[number].link)
        self._alarm.set(self.selection.next_deadline())

    def _choose(self) -> None:
        """Follow a change of the chosen links."""
        before = self._used
        withouts = {_ALL, *self._without.values()}
        self._used = {without: self.selection.used(self._now(), without) for without in withouts}
        changed = set().union(*(used ^ before.get(without, _ALL) for without, used in self._used.items()))
        ports = [port for number in sorted(changed) if (port := self._by_number.get(number)) and port.link.up]
        for port in ports:
            if port.number in self._used[_ALL]:
                if port.link.stands_by:
                    port.link.stands_by = ""
                    self._notify(port.link, "used", "is used again", False)
            elif port.number in before[_ALL]:
                port.link.stats.lost["standing by"] += port.link.discard()  # what waits there would arrive twice
        for topic in self._space.topics.values():
            topic.drop_filter = self._drop_filter(topic) if self._filtering else None
        self._announce(list(self._space.topics.values()), [port.link for port in ports])

    def _announce(self, topics: list[Topic], links: list[Link]) -> None:
        """Have these links announce the new state of these topics."""
        for topic in topics:
            for link in links:
                link.stats.lost.guard(link.topic_changed, topic)

    def _report_unused(self, number: int, link: Link) -> None:
        other = self.selection.stands_by_for(number) if link.up and not link.stands_by else None
        if other is not None:
            link.stands_by = self._reason(number, self._by_number[other])
            self._notify(link, "stands by", link.stands_by, False)

    def _reason(self, number: int, other: "_MultihomedPort") -> str:
        candidate = self.selection.by_number[number]
        if self.selection.is_twin(number):
            return f"stands by: it leads to the same network as {other.link.name}"
        if candidate.remote is not None:
            return f"stands by: it leads to the same module as {other.link.name}"
        gateways = {gateway for gateway, _ in candidate.gateways}
        modules = self._by_number[number].link.discovery.modules.values()
        names = [info.name for info in modules if info.instance in gateways]
        joins = f"gateway {names[0]} joins" if len(names) == 1 else "gateways join"
        return f"stands by: {joins} its network to that of {other.link.name}"


class _MultihomedPort(GatewayHooks):
    """One link of the module, and the module's decisions about it."""

    def __init__(self, owner: MultihomedModule, link: Link, number: int) -> None:
        self.link = link
        self.number = number
        self.generation = -1
        """Generation of discovery at the last look."""
        self._owner = owner

    def handle_management(self, data: bytes) -> bool:
        return self._owner.handle_management(self, data)

    def desired_state(self, topic: Topic, own: Announcement) -> Announcement:
        return own if self._owner.review_use(topic, self) else NOTHING

    def types_elsewhere(self, topic: str) -> tuple[TopicType, TopicType]:
        return TopicType(), TopicType()

    @property
    def may_announce(self) -> bool:
        return not self._owner.selection.is_twin(self.number)

    @property
    def has_other_gateways(self) -> bool:
        return self._owner.selection.may_announce

    def source_name(self, source: Source) -> str:
        return source.module

    def discovery_changed(self) -> None:
        self._owner.discovery_changed(self)


def _cannot_carry(link: Link, name_length: int, size: int, varies: bool) -> bool:
    """Return whether a topic's name, or some of its messages of `size` bytes (0: not known), are too long for the link.

    If their length `varies`, they have at most so many.
    """
    return name_length > link.max_name or size > link.longest(varies=varies)
