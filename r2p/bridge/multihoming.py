"""A module that is no gateway, with several links: it uses each topic on one of those that gateways join.

A link hears NOTHING of a topic that uses another link (`r2p.protocols.bridge.link_selection`), and others see the
module's nodes there as gateways tell of them. A topic that a link can't carry, as its name or its messages are too
long, takes the next link that can.
"""

from collections.abc import Callable

from r2p.clock import Alarm
from r2p.codecs import UnknownType, management, probes
from r2p.codecs.management import ManagementType
from r2p.errors import DecodeError
from r2p.protocols.bridge.link_selection import LinkSelection
from r2p.runtime.sample import Source
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.announcement import NOTHING, Announcement
from r2p.transports.link import Link
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error

_KINDS = {ManagementType.ALIVE, ManagementType.HELLO, *management.GATEWAY_TYPES}
_ALL: frozenset[int] = frozenset()


class StandbyPort:
    """One link: where hellos of gateways come in, and where it is decided what the link is told."""

    def __init__(self, standby: "MultihomedModule", link: Link, number: int) -> None:
        self.link = link
        self.number = number
        self.generation = -1
        """Of what was known of the modules there when it was looked at last."""
        self._standby = standby

    def handle_management(self, data: bytes) -> bool:
        return self._standby.handle_management(self, data)

    def desired_state(self, topic: Topic, own: Announcement) -> Announcement:
        return own if self._standby.uses(topic, self) else NOTHING

    @property
    def may_announce(self) -> bool:
        return not self._standby.homes.is_twin(self.number)

    @property
    def has_other_gateways(self) -> bool:
        return self._standby.homes.may_announce

    def source_name(self, source: Source) -> str:
        return source.module

    def discovery_changed(self) -> None:
        self._standby.discovery_changed(self)


class MultihomedModule:
    """The links of one module. `told(link, kind, text, trouble)` is called with news for the user."""

    def __init__(self, space: TopicSpace, instance: int, told: Callable[[Link, str, str, bool], None]) -> None:
        self.homes = LinkSelection(instance)
        self._space = space
        self._instance = instance
        self._told = told
        self._ports: dict[str, StandbyPort] = {}  # by the name of the link
        self._by_number: dict[int, StandbyPort] = {}
        self._attached = 0
        self._changes = 0
        self._used = {_ALL: self.homes.used(0, _ALL)}  # by the links that can't carry a topic
        self._without: dict[str, frozenset[int]] = {}
        self._unable: dict[tuple[int, int], frozenset[int]] = {}
        self._guarding = False
        self._alarm = Alarm(space.loop, self._poll, background=True)

    # Links

    def attach(self, link: Link) -> None:
        """The module has a link, up or not yet; those that come first are preferred."""
        self._attached += 1
        port = StandbyPort(self, link, self._attached)
        self._ports[link.name] = self._by_number[port.number] = port
        for key, unable in self._unable.items():
            if _cannot_carry(link, *key):
                self._unable[key] = unable | {port.number}
        link.gateway_hooks = port

    def detach(self, link: Link) -> None:
        """It does not have it any more."""
        port = self._ports.pop(link.name)
        del self._by_number[port.number]
        for key, unable in self._unable.items():
            if port.number in unable:
                self._unable[key] = unable - {port.number}
        self.homes.shut(self._now(), port.number)
        self.homes.forget(port.number)
        self._act()

    def link_changed(self, link: Link) -> None:
        """It went up or down."""
        port = self._ports.get(link.name)
        if port is None:
            return
        if link.up:
            self.homes.open(self._now(), port.number, lone=link.point_to_point)
        else:
            self.homes.shut(self._now(), port.number)
            link.stands_by = ""
        self._act()
        if link.up and port.number not in self._used[_ALL]:
            self._retell([link])

    def close(self) -> None:
        self._alarm.close()

    # What comes in

    def handle_management(self, port: StandbyPort, data: bytes) -> bool:
        """A management message; True if discovery need not see it."""
        if management.type_of(data) not in _KINDS:
            return False
        try:
            message = management.decode(data)
        except (DecodeError, UnknownType):
            return False
        ours = self._heard(self._now(), port, message, data)
        if ours:
            self._act()
        return ours

    def _heard(self, now: int, port: StandbyPort, message: management.Management, data: bytes) -> bool:
        match message:
            case management.Bridge():
                self.homes.bridge(now, port.number, message)
            case management.Leaf(self._instance):
                self.homes.leaf(now, port.number, message)
            case management.Hello(_, self._instance, hops=0) | management.Alive(self._space.module):
                return self.homes.heard_ourselves(now, port.number)
            case management.Alive() if (probe := probes.decode(data)) is not None and probe[0] == self._instance:
                self.homes.probed(now, port.number, probe[1])
            case management.Leaf() | management.Mesh():
                pass
            case _:
                return False
        return True

    def discovery_changed(self, port: StandbyPort) -> None:
        """Discovery may have learnt who is at the other end, or how long messages are of which we did not know it."""
        if port.link.point_to_point and port.link.discovery.generation != port.generation:
            port.generation = port.link.discovery.generation
            self.homes.ended(self._now(), port.number, port.link.discovery.sole_peer)
            self._act()
        if len(self._used[_ALL]) == len(self.homes.by_number):
            return
        for topic in list(self._space.topics.values()):
            if (
                topic.layout is None
                and not topic.unused
                and self._without.get(topic.name, _ALL) != self._unable_for(topic)
            ):
                self._retell_topic(topic)

    # Topics

    def uses(self, topic: Topic, port: StandbyPort) -> bool:
        """Whether the topic takes this link; one that is down keeps what it had, until it is up again."""
        if port.number not in self.homes.by_number:
            return True
        without = self._unable_for(topic)
        if topic.unused:
            self._without.pop(topic.name, None)
        else:
            self._without[topic.name] = without
        topic.drop_filter = self._guard_of(topic) if self._guarding else None
        return port.number in without or port.number in self.homes.used(self._now(), without)

    def _unable_for(self, topic: Topic) -> frozenset[int]:
        """The links that can't carry it."""
        size = topic.layout.size if topic.layout is not None else 0
        if not size:
            infos = (port.link.discovery.topics.get(topic.name) for port in self._by_number.values())
            size = max((info.size for info in infos if info is not None), default=0)
        key = len(topic.name), size
        if key not in self._unable:
            ports = self._by_number.items()
            self._unable[key] = frozenset(number for number, port in ports if _cannot_carry(port.link, *key))
        return self._unable[key]

    def _guard_of(self, topic: Topic) -> Callable[[str], bool]:
        """Asked before each message while gateways consent to the use of several links for a while only: a module that
        was stopped must not go on with them. Says whether the message came in by a link that is not used any more.
        """

        def guard(link: str) -> bool:
            if self._now() >= self.homes.until:
                self._poll()
            port = self._ports.get(link)
            return port is not None and not self.uses(topic, port)

        return guard

    # What follows

    def _now(self) -> int:
        return self._space.clock.monotonic()

    def _poll(self) -> None:
        try:
            self.homes.poll(self._now())
            self._act()
        except Exception as error:  # noqa: BLE001 - counted and logged
            count_internal_error((port.link.stats.lost for port in self._ports.values()), error)
            self._alarm.set(self._now() + RETRY_AFTER_ERROR)

    def _act(self) -> None:
        for number, message in self.homes.take():
            link = self._by_number[number].link
            if link.up and message is not None:
                link.write_management(management.encode(message), urgent=True)
            elif link.up and link.passes_probes:
                link.write_management(probes.encode(self._instance, number))
        guarding = self.homes.guards
        if self.homes.changes != self._changes or guarding != self._guarding:
            self._changes = self.homes.changes
            self._guarding = guarding
            self._choose()
        for number in self._by_number.keys() - self._used[_ALL]:
            self._tell_user(number, self._by_number[number].link)
        self._alarm.set(self.homes.next_deadline())

    def _choose(self) -> None:
        """Other links are used than before."""
        before = self._used
        withouts = {_ALL, *self._without.values()}
        self._used = {without: self.homes.used(self._now(), without) for without in withouts}
        changed = set().union(*(used ^ before.get(without, _ALL) for without, used in self._used.items()))
        ports = [port for number in sorted(changed) if (port := self._by_number.get(number)) and port.link.up]
        for port in ports:
            if port.number in self._used[_ALL]:
                self._tell_used(port.link)
            elif port.number in before[_ALL]:
                port.link.stats.lost["standing by"] += port.link.discard()
        for topic in self._space.topics.values():
            topic.drop_filter = self._guard_of(topic) if self._guarding else None
        self._retell([port.link for port in ports])

    def _retell(self, links: list[Link]) -> None:
        for topic in list(self._space.topics.values()):
            for link in links:
                link.stats.lost.guard(link.topic_changed, topic)

    def _retell_topic(self, topic: Topic) -> None:
        for port in list(self._by_number.values()):
            if port.link.up:
                port.link.stats.lost.guard(port.link.topic_changed, topic)

    def _tell_used(self, link: Link) -> None:
        if link.stands_by:
            link.stands_by = ""
            self._told(link, "used", "is used again", False)

    def _tell_user(self, number: int, link: Link) -> None:
        """Of a link that is not used."""
        other = self.homes.stands_by_for(number) if link.up and not link.stands_by else None
        if other is not None:
            link.stands_by = self._reason(number, self._by_number[other])
            self._told(link, "stands by", link.stands_by, False)

    def _reason(self, number: int, other: StandbyPort) -> str:
        if self.homes.is_twin(number):
            return f"stands by: it leads to the same network as {other.link.name}"
        if self.homes.by_number[number].end is not None:
            return f"stands by: it leads to the same module as {other.link.name}"
        link = self._by_number[number].link
        gateways = {gateway for gateway, _ in self.homes.by_number[number].gateways}
        names = [info.name for info in link.discovery.modules.values() if info.instance in gateways]
        joins = f"gateway {names[0]} joins" if len(names) == 1 else "gateways join"
        return f"stands by: {joins} its network to that of {other.link.name}"


def _cannot_carry(link: Link, name_length: int, size: int) -> bool:
    """Whether a topic's name, or its messages of `size` bytes (0: not known), are too long for the link."""
    return name_length > link.max_name or (size > 0 and link.refusal(size) is not None)
