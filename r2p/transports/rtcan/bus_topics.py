"""The topics `bus_load` and `bus_slots`: what is on an RTCAN bus, for subscribers anywhere in the network.

    r2p topic echo bus_load --via tcp:robot:23       # on a PC, behind the gateway of the bus

While discovery knows a subscriber, one r2p module of the bus publishes them, and receives all frames for that. Without
a subscriber they are not advertised, and cost nothing. All modules decide alike which one it is: a gateway, if there is
one, as subscribers are likely to be behind it, and the numbers themselves then need no bus.

A module on the bus can also have them for itself, without a message on the bus: `RtcanLink.bus_listeners`.
"""

import asyncio
import re
from collections.abc import Hashable, Iterator
from typing import TYPE_CHECKING, Any

from r2p.clock import Alarm
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.codecs.own_services import WIRE_MIN
from r2p.errors import TypeMismatch
from r2p.log_lines import get_logger
from r2p.messages import layout
from r2p.msg import BusSlots, BusTraffic
from r2p.names import BUS_LOAD, BUS_SLOTS, module_alias
from r2p.protocols.rtcan import monitor
from r2p.protocols.rtcan.monitor import FrameKind, Monitor
from r2p.runtime.node import Node
from r2p.transports.link import Hub
from r2p.transports.rtcan.link import RtcanLink
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from r2p.runtime.publishers.non_real_time import Publisher

logger = get_logger("r2p.rtcan")

_TYPES: dict[str, type[BusTraffic | BusSlots]] = {BUS_LOAD: BusTraffic, BUS_SLOTS: BusSlots}
_LOOK_INTERVAL = SECOND // 5  # ns between two looks for subscribers
_TURN = SECOND  # ns that a module gives each module that is to publish rather than itself
_READ_AFTER = 40 * MILLISECOND  # ns after a second until its last frames are read
_RESENT = 2  # times that all slots are sent for a new subscriber, as at first the way there may not be complete
_BUS_MAX, _TOPIC_MAX, _MODULE_MAX = 32, 72, 64  # bytes, as in the messages
_Owner = tuple[str, str]
"""A topic and its module."""


class BusReporter:
    """Publishes what is on the bus of one link, while that is wanted and up to this module; until it is closed."""

    def __init__(self, link: RtcanLink, hub: Hub) -> None:
        self._link = link
        self._space = hub.space
        self._subscribers = _Subscribers(hub)
        self._wanted_since: int | None = None
        self._refused = self._watching = False
        self._node: Node | None = None
        self._publishers: dict[str, Publisher[Any]] = {}
        self._publishing: asyncio.Task[None] | None = None
        # A callback, and no task that sleeps: under virtual time it keeps no program going.
        self._alarm = Alarm(hub.space.loop, self._look, background=True)
        self._observer = hub.observer
        self._alarm.set(self._space.clock.monotonic() + _LOOK_INTERVAL)

    def close(self) -> None:
        """Stop for good."""
        self._alarm.close()
        if self._publishing is not None:
            self._publishing.cancel()
        self._end()

    def _look(self) -> None:
        self._alarm.set(self._space.clock.monotonic() + _LOOK_INTERVAL)
        if self._publishing is None:
            self._link.stats.lost.guard(self._begin)

    def _begin(self) -> None:
        if self._link.bus_listeners or self._wanted():
            self._publishing = self._space.loop.create_task(self._publish(), name=f"{self._link.name} bus topics")

    # Whether this module publishes

    def _wanted(self) -> set[str]:
        """Return the topics that this module is to publish now; a tool publishes none."""
        if self._observer:
            return set()
        now, discovery = self._space.clock.monotonic(), self._link.discovery
        wanted = {topic for topic in _TYPES if self._subscribers.of(topic) and not self._is_other_topic(topic)}
        if not wanted or not self._link.up or self._refused:
            self._wanted_since = None
            return set()
        own = not discovery.is_gateway, module_alias(self._space.module)
        ahead = {
            info.instance
            for info in discovery.modules.values()
            if info.r2p and not info.hops and not info.observer and info.wire >= WIRE_MIN
            if (not info.gateway, module_alias(info.name)) < own
        }
        if self._wanted_since is None or any(
            each.topic in _TYPES and each.role == ROLE_PUBLISHES and each.instance in ahead
            for each in discovery.endpoints.values()
        ):
            self._wanted_since = now
        # One that is ahead and does not publish has an older version of r2p, or does not see the subscriber yet.
        return wanted if now - self._wanted_since >= len(ahead) * _TURN else set()

    def _is_other_topic(self, topic: str) -> bool:
        """Return whether others use the name for messages of another type, so that this module must not publish it."""
        own = layout(_TYPES[topic]).fingerprint
        here = self._space.topics.get(topic)
        known = [here.layout.fingerprint] if here is not None and here.layout is not None else []
        found = [link.discovery.topics.get(topic) for link in self._space.links]
        known += [each.fingerprint for each in found if each is not None and each.fingerprint is not None]
        return any(each != own for each in known)

    # Publishing

    async def _publish(self) -> None:
        """Publish once a second, until another module takes over and no listener is left."""
        try:
            await self._publish_while_wanted()
        except TypeMismatch as error:
            self._refused = True
            logger.info("link %s: nothing is published about the bus: %s", self._link.title, error)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next look begins anew
            self._link.stats.lost.internal_error(error)
        finally:
            self._publishing = None
            self._end()

    async def _publish_while_wanted(self) -> None:
        driver = self._link.driver
        watching = Monitor(self._link.engine.timing)
        owners = _SlotOwners()
        end = driver.now()
        watching.reset(end, SECOND)
        driver.watch(watching)
        self._watching = True
        while (wanted := self._wanted()) or self._link.bus_listeners:
            self._advertise(wanted)
            self._learn_names(watching)  # early: frames of the next second end this one
            if driver.now() < end + SECOND + _READ_AFTER:
                left = end + SECOND + _READ_AFTER - driver.now()
                await asyncio.sleep(min(left, _LOOK_INTERVAL) / SECOND)
                continue
            end += SECOND
            load = watching.next_load()
            if driver.now() >= end + SECOND + _READ_AFTER:
                continue  # the program stood still: only the last second counts
            changed = owners.update(load.slots, self._link.master, self._subscribers.of(BUS_SLOTS))
            for listener in list(self._link.bus_listeners):
                slots = [self._slot_row(*each, watching) for each in owners.owned.items()]
                listener(list(self._load_rows(load)), slots)
            if BUS_LOAD in self._publishers:
                for row in self._load_rows(load):
                    await self._publishers[BUS_LOAD].publish(row)
            if BUS_SLOTS in self._publishers:
                for owner, indices in changed:
                    await self._publishers[BUS_SLOTS].publish(self._slot_row(owner, indices, watching))

    def _advertise(self, wanted: set[str]) -> None:
        """Advertise the topics that are wanted now, and no others."""
        if self._node is None and wanted:
            # With a node for each bus, as the messages of two publishers of one node would count as repetitions.
            self._node = Node("bus_" + re.sub(r"\W", "_", self._link.name, flags=re.ASCII)[:_BUS_MAX], self._space)
        for topic in wanted - self._publishers.keys():
            assert self._node is not None
            self._publishers[topic] = self._node.advertise(topic, _TYPES[topic])
        for topic in self._publishers.keys() - wanted:
            self._publishers.pop(topic).close()

    def _end(self) -> None:
        """Leave the bus to itself."""
        if self._watching:
            self._watching = False
            self._link.driver.watch(None)
        if self._node is not None:
            self._node.close()
        self._node = None
        self._publishers.clear()

    # What is on the bus

    def _learn_names(self, watching: Monitor) -> None:
        """Enter what the link knows of the bus: the monitor itself knows only what was announced meanwhile."""
        modules = self._link.discovery.modules.values()
        names = {each.source: each.name for each in modules if isinstance(each.source, int) and not each.hops}
        directory = watching.directory
        directory.modules |= names | {self._link.engine.id8 or 0: self._space.module}
        directory.topics |= self._link.topics_on_bus()

    def _load_rows(self, load: monitor.BusLoad) -> Iterator[BusTraffic]:
        bus, seconds = _cut(self._link.title, _BUS_MAX), load.elapsed / SECOND
        yield BusTraffic(
            bus=bus,
            kind="total",
            share=load.total,
            frames=sum(each.frames for each in load.tallies.values()) / seconds,
            errors=sum(load.faults.values()),
            reserved=load.reserved,
            free_used=load.free_used,
        )
        by_bits = sorted(load.tallies.items(), key=lambda each: -each[1].bits)
        for (topic, module, kind), tally in by_bits:
            yield BusTraffic(
                bus=bus,
                kind=kind.value,
                topic=self._short(topic),
                module=_cut(module or (self._link.master if kind is FrameKind.SYNC else ""), _MODULE_MAX),
                share=load.share(tally.bits),
                frames=tally.frames / seconds,
            )

    def _slot_row(self, owner: _Owner, slots: tuple[int, ...], watching: Monitor) -> BusSlots:
        timing = watching.directory.timing
        return BusSlots(
            bus=_cut(self._link.title, _BUS_MAX),
            topic=self._short(owner[0]),
            module=_cut(owner[1], _MODULE_MAX),
            slots=slots,
            slots_in_cycle=timing.slots,
            cycle=timing.cycle / SECOND,
        )

    def _short(self, topic: str) -> str:
        """Return the name of a topic, or its alias if the messages have no room for it."""
        return topic if len(topic) <= _TOPIC_MAX else self._link.discovery.alias(topic)


class _SlotOwners:
    """The slots of each owner, and what subscribers know of them."""

    def __init__(self) -> None:
        self._by_slot: dict[int, list[_Owner]] = {}
        self.owned: dict[_Owner, tuple[int, ...]] = {}
        """The slots of each owner now."""
        self._known_to: frozenset[Hashable] = frozenset()
        self._resend = 0

    def update(
        self, slots: list[monitor.BusSlot], master: str, subscribers: frozenset[Hashable]
    ) -> list[tuple[_Owner, tuple[int, ...]]]:
        """Enter the slots of the last second; return those owners with their slots that subscribers are to get."""
        self._resend = _RESENT if subscribers - self._known_to else max(0, self._resend - 1)
        self._known_to = subscribers
        before, self.owned = self.owned, self._by_owner(slots, master)
        gone: list[tuple[_Owner, tuple[int, ...]]] = [(owner, ()) for owner in before if owner not in self.owned]
        return gone + [each for each in self.owned.items() if self._resend or before.get(each[0]) != each[1]]

    def _by_owner(self, slots: list[monitor.BusSlot], master: str) -> dict[_Owner, tuple[int, ...]]:
        owned: dict[_Owner, list[int]] = {}
        for index, slot in enumerate(slots):
            if not slot.reserved:
                self._by_slot.pop(index, None)
                continue
            if slot.senders:  # else its owner is still the last one, which has nothing to send
                self._by_slot[index] = list(slot.senders)
            for topic, module in self._by_slot.get(index, [("", "")]):
                owned.setdefault((topic, module or (master if topic == "sync" else "")), []).append(index)
        return {owner: tuple(indices) for owner, indices in owned.items()}


class _Subscribers:
    """The subscribers of topics in the whole network, looked up only where something has changed."""

    def __init__(self, hub: Hub) -> None:
        self._instance = hub.instance
        self._space = hub.space
        self._seen: list[object] = []
        self._found: dict[str, frozenset[Hashable]] = {}

    def of(self, topic: str) -> frozenset[Hashable]:
        """Return the subscribers of one of the topics, in this module and others."""
        queues = [id(each) for name in _TYPES if name in self._space.topics for each in self._space.topics[name].queues]
        seen = [*queues, *((link.name, link.discovery.generation) for link in self._space.links)]
        if seen != self._seen:
            self._seen = seen
            self._found = {name: self._look_up(name) for name in _TYPES}
        return self._found[topic]

    def _look_up(self, topic: str) -> frozenset[Hashable]:
        known = self._space.topics.get(topic)
        here = [id(each) for each in known.queues] if known is not None else []
        others = (each for link in self._space.links for each in link.discovery.endpoints.values())
        return frozenset(here) | {
            (each.instance, each.node)
            for each in others
            if each.topic == topic and each.role == ROLE_SUBSCRIBES and each.instance != self._instance
        }


def _cut(name: str, size: int) -> str:
    return name.encode()[:size].decode(errors="ignore")
