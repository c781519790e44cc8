"""The management protocol of one link (PROTOCOL.md 4 and 9): who is there, and what may flow.

The protocol is stateless and lazy: everything is said again and again, every request is answered every time, and nothing
depends on a single message. `Announcer` says what this module has, `Exchange` answers what others want, `Directory`
remembers what was heard; `Discovery` puts them together, and tells modules, restarts and namesakes apart.
"""

from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

from r2p.codecs import UnknownType, management
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.protocols.announcer import Announcer, Own
from r2p.protocols.directory import FOR_EVER, LEASE, Directory, EndpointInfo, EndpointKey, TopicInfo
from r2p.protocols.events import (
    Command,
    Echoes,
    Event,
    Joined,
    Left,
    Mismatched,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    NameConflict,
    Obey,
    Opened,
    Send,
    Shape,
    Shut,
    Source,
)
from r2p.protocols.exchange import Exchange
from r2p.protocols.outbox import Outbox
from r2p.protocols.schedule import Kind, Schedule, Timers

__all__ = [
    "Command",
    "Discovery",
    "Echoes",
    "EndpointInfo",
    "Event",
    "Joined",
    "Left",
    "Mismatched",
    "ModuleChanged",
    "ModuleGone",
    "ModuleInfo",
    "NameConflict",
    "Obey",
    "Opened",
    "Send",
    "Shape",
    "Shut",
    "Source",
    "TopicInfo",
]

_SECOND = 1_000_000_000
_TELL_AGAIN = 5 * _SECOND
"""Conflicts and echoes are told at most this often."""
_ECHO_MEMORY = 10 * _SECOND
"""A line that echoed is expected to do so for this long."""
_SWAPS = 3
"""A name that goes back and forth between two instances this often belongs to two modules."""
_RESTART = management.FLAG_REBOOTED | management.FLAG_BOOT
_ORDERS: dict[Command, Callable[[str], management.Management]] = {
    Command.STOP: management.Stop,
    Command.REBOOT: management.Reboot,
    Command.BOOTLOAD: management.Bootload,
}


class Discovery:
    """The management protocol of one link.

    `rate` is the most management messages a second that nobody asked for, `burst` how many of them may go at once,
    `quiet` the time (s) without management traffic before something is repeated. An `observer` sends no ALIVE.

    Every method takes `now` (monotonic ns) and gives back what to do, in order; call `poll` at `next_deadline()`.
    """

    def __init__(
        self,
        module: str,
        instance: int,
        *,
        rate: float = 250.0,
        burst: int = 32,
        quiet: float = 0.0,
        observer: bool = False,
    ) -> None:
        self.counts: Counter[str] = Counter()
        """Received messages that were dropped, by reason."""
        self._module = module
        self._instance = instance
        self._outbox = Outbox()
        self._schedule = Schedule(rate, burst, round(quiet * _SECOND))
        self._announcer = Announcer(module, instance, self._schedule, self._outbox, observer=observer)
        self._timers = Timers()
        self._directory = Directory(self.counts)
        self._exchange = Exchange(self._announcer, self._outbox, self._directory, self._timers, self.counts)
        self._echoing_until = 0
        self._silent_until: dict[str, int] = {}
        self._handlers: dict[type, Callable[[int, Any, Source], None]] = {
            management.Alive: self._alive,
            management.Stop: self._stop,
            management.Reboot: self._reboot,
            management.Bootload: self._bootload,
            management.Advertise: self._exchange.advertised,
            management.SubscribeRequest: self._exchange.requested,
            management.SubscribeResponse: self._exchange.responded,
            management.Hello: self._hello,
            management.TypeInfo: self._exchange.typed,
            management.Unsubscribe: self._exchange.unsubscribed,
            management.Endpoint: self._endpoint,
            management.Conflict: self._conflict,
        }

    # What was learnt

    @property
    def flags(self) -> int:
        """Our own flags, as in ALIVE."""
        return self._announcer.flags

    @property
    def modules(self) -> dict[str, ModuleInfo]:
        """The modules heard on the link, by name; one of our own name is another module that has it too."""
        return self._directory.modules

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """The topics heard of on the link, by name."""
        return self._directory.topics

    @property
    def endpoints(self) -> dict[EndpointKey, EndpointInfo]:
        """The publishers and subscribers of remote nodes, by instance, node, topic and role."""
        return self._directory.endpoints

    # What the module has and wants

    def set_flags(self, now: int, flags: int) -> list[Event]:
        """The module's state changed: tell at once. `flags` are FLAG_... of ALIVE."""
        if flags != self._announcer.flags:
            self._announcer.flags = flags
            self._announcer.once(Kind.PRESENCE)
        return self._go_on(now)

    def advertise(
        self, now: int, topic: str, size: int, fingerprint: bytes = ANY_TYPE, params: bytes = NO_PARAMS
    ) -> list[Event]:
        """The module publishes this topic: messages of `size` bytes. `params` are the transport's."""
        if self._announcer.publish(topic, Own(Shape(size, fingerprint), params)):
            self._exchange.retyped(topic, ROLE_SUBSCRIBES)
        return self._go_on(now)

    def withdraw(self, now: int, topic: str) -> list[Event]:
        """The module does not publish this topic any more: whoever joined has left."""
        if self._announcer.withdraw(topic):
            self._exchange.withdrawn(topic)
        return self._go_on(now)

    def subscribe(
        self, now: int, topic: str, size: int = 0, queue: int = 16, fingerprint: bytes = ANY_TYPE
    ) -> list[Event]:
        """The module subscribes this topic. Size 0 and no fingerprint: whatever its type is."""
        own = Own(Shape(size, fingerprint), queue=min(max(queue, 1), 0xFFFF))
        if self._announcer.subscribe(topic, own):
            self._exchange.retyped(topic, ROLE_PUBLISHES)
        return self._go_on(now)

    def unsubscribe(self, now: int, topic: str) -> list[Event]:
        """The module does not subscribe this topic any more: what was opened is shut."""
        if self._announcer.unsubscribe(topic):
            self._exchange.unwanted(topic)
        return self._go_on(now)

    def endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        """A node publishes or subscribes (ROLE_...) the topic, as CLASS_...; told to r2p modules only."""
        self._announcer.endpoint(node, topic, role, publisher_class)
        return self._go_on(now)

    def endpoint_gone(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        """It does not any more."""
        self._announcer.endpoint_gone(node, topic, role)
        return self._go_on(now)

    # What a person or the shell wants

    def command(self, now: int, command: Command, module: str) -> list[Event]:
        """Order a module to stop, reboot or enter its loader."""
        self._outbox.say(_ORDERS[command](module), urgent=True)
        return self._go_on(now)

    def query(self, now: int) -> list[Event]:
        """Ask everybody to repeat what they publish and subscribe."""
        self._announcer.once(Kind.QUERY)
        return self._go_on(now)

    def conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        """Tell the link that two modules, which don't hear each other, carry one name."""
        self._announcer.once(Kind.CONFLICT, module, instance_a, instance_b)
        return self._go_on(now)

    # The link

    def link_up(self, now: int) -> list[Event]:
        """The other end can be reached: introduce yourself, ask, and announce everything."""
        self._outbox.up = True
        self._schedule.start(now)
        return self._go_on(now)

    def link_down(self, now: int) -> list[Event]:
        """The other end is away. Leases end; firmware's subscriptions stay, it does not notice a reconnect."""
        self._outbox.up = False
        self._schedule.stop()
        self._directory.endpoints.clear()
        self._echoing_until = 0
        for info in [info for info in self.modules.values() if info.r2p]:
            self._gone(now, info)
        self._exchange.interrupted()
        return self._outbox.take()

    def leave(self, now: int) -> list[Event]:
        """Say good-bye; nothing is sent after it."""
        self._outbox.say(self._announcer.introduction(management.HELLO_LEAVING))
        self._outbox.up = False
        self._schedule.stop()
        return self._outbox.take()

    def next_deadline(self) -> int | None:
        """When to call `poll` (monotonic ns); a time in the past means at once."""
        due = self._timers.next()
        if not self._outbox.up:
            return due
        turn = self._schedule.due()
        return turn if due is None else min(due, turn)

    def poll(self, now: int) -> list[Event]:
        """What the time brings: leases run out, things are repeated."""
        for key in self._timers.pop(now):
            self._expired(now, key)
        return self._go_on(now)

    def receive(self, now: int, data: bytes, source: Source = None) -> list[Event]:
        """A message of the topic `R2P` came in from `source`. Never raises for bad bytes: they are counted."""
        if not self._outbox.up:
            self.counts["link down"] += 1
            return []
        self._schedule.traffic(now)
        try:
            message = management.decode(data)
        except UnknownType:
            self.counts["unknown type"] += 1
        except DecodeError:
            self.counts["undecodable"] += 1
        else:
            handler = self._handlers.get(type(message))
            if handler is not None and not self._is_echo(now, data):
                handler(now, message, source)
        return self._outbox.take()

    def _go_on(self, now: int) -> list[Event]:
        self._announcer.go_on(now)
        return self._outbox.take()

    # Modules

    def _alive(self, now: int, message: management.Alive, source: Source) -> None:
        if message.module == self._module and not self._is_namesake(now):
            return
        before, info = self._directory.alive(now, message, source)
        if before is not None and _restarted(before.flags, info.flags):
            self._exchange.restarted(source)
        self._keep(now, before, info)

    def _is_namesake(self, now: int) -> bool:
        """Our own name in an ALIVE: an echo, or somebody else's. Says whether that is a module to remember."""
        if now < self._echoing_until:
            self.counts["echo"] += 1
            return False
        namesake = self.modules.get(self._module)
        self._tell_conflict(now, self._module, self._instance, namesake.instance if namesake is not None else None)
        return namesake is not None

    def _hello(self, now: int, message: management.Hello, source: Source) -> None:
        if (message.module, message.instance) == (self._module, self._instance):
            self._echo(now)
        elif message.flags & management.HELLO_LEAVING:
            self._leaving(now, message, source)
        else:
            self._present(now, message, source)

    def _present(self, now: int, message: management.Hello, source: Source) -> None:
        """An r2p module introduces itself, for the first time or again."""
        known_start = self._directory.was(message.module, message.instance)
        before, info = self._directory.hello(now, message, source)
        self._look_for_namesakes(now, before, message)
        is_new = not known_start and (before is None or before.instance != info.instance)
        if before is not None and (before.source, before.hops) != (info.source, info.hops):
            self._exchange.moved_away(now, before)
        if message.hops == 0:
            self._exchange.met(now, info, is_new=is_new)
        self._keep(now, before, info)
        if is_new or message.flags & management.HELLO_QUERY:
            self._schedule.repeat(now)

    def _look_for_namesakes(self, now: int, before: ModuleInfo | None, message: management.Hello) -> None:
        swaps = self._directory.count_swaps(now, before, message.instance)
        if message.module == self._module:
            self._tell_conflict(now, message.module, self._instance, message.instance)
        elif before is not None and swaps >= _SWAPS:
            self._tell_conflict(now, message.module, before.instance, message.instance)

    def _leaving(self, now: int, message: management.Hello, source: Source) -> None:
        info = self.modules.get(message.module)
        if info is not None and info.instance == message.instance:
            self._gone(now, info)
        elif message.hops == 0:
            self._exchange.left(now, source)

    def _keep(self, now: int, before: ModuleInfo | None, info: ModuleInfo) -> None:
        """Enter what was heard of a module, and tell if it is more than a sign of life."""
        forgotten = self._directory.keep(info)
        if info.r2p:
            self._timers.set(("module", info.name), now + info.lease)
        if before is None or _as_heard(before) != _as_heard(info):
            self._outbox.tell(ModuleChanged(info))
        if forgotten is not None and forgotten.r2p:
            self._gone(now, forgotten)
        self._announcer.follow(r2p=self._directory.knows_r2p)

    def _gone(self, now: int, info: ModuleInfo) -> None:
        self._directory.remove(info)
        self._timers.clear(("module", info.name))
        self._outbox.tell(ModuleGone(info))
        self._exchange.moved_away(now, info)
        self._announcer.follow(r2p=self._directory.knows_r2p)

    def _endpoint(self, now: int, message: management.Endpoint, source: Source) -> None:
        if message.instance == self._instance:
            return
        key = self._directory.endpoint(message)
        info = self.modules.get(self._directory.name_of(message.instance))
        lease = info.lease if info is not None else LEASE
        if key is not None and lease < FOR_EVER:
            self._timers.set(("endpoint", key), now + lease)

    def _expired(self, now: int, key: Hashable) -> None:
        match key:
            case ("lease", source, str(topic)):
                self._exchange.lease_over(source, topic)
            case ("module", str(name)):
                self._gone(now, self.modules[name])
            case ("peer", source):
                self._exchange.memory_over(source)
            case ("endpoint", (int(instance), str(node), str(topic), int(role))):
                self.endpoints.pop((instance, node, topic, role), None)

    # Names and echoes

    def _conflict(self, now: int, message: management.Conflict, source: Source) -> None:
        instances = (message.instance_a, message.instance_b)
        if message.module == self._module and self._instance in instances:
            self._tell_conflict(now, message.module, *instances)

    def _tell_conflict(self, now: int, module: str, instance_a: int | None, instance_b: int | None) -> None:
        if self._may_tell(now, module):
            self._outbox.tell(NameConflict(module, instance_a, instance_b))

    def _echo(self, now: int) -> None:
        self.counts["echo"] += 1
        self._echoing_until = now + _ECHO_MEMORY
        if self._may_tell(now, ""):
            self._outbox.tell(Echoes())

    def _is_echo(self, now: int, data: bytes) -> bool:
        """Whether a line that echoes gave back one of the last messages; our HELLO is how we know that it does."""
        if now >= self._echoing_until or not self._outbox.forget(data):
            return False
        self._echoing_until = now + _ECHO_MEMORY
        self.counts["echo"] += 1
        return True

    def _may_tell(self, now: int, what: str) -> bool:
        if now < self._silent_until.get(what, now):
            return False
        self._silent_until = {each: until for each, until in self._silent_until.items() if until > now}
        self._silent_until[what] = now + _TELL_AGAIN
        return True

    # Orders

    def _stop(self, now: int, message: management.Stop, source: Source) -> None:
        self._obey(Command.STOP, message.module)

    def _reboot(self, now: int, message: management.Reboot, source: Source) -> None:
        self._obey(Command.REBOOT, message.module)

    def _bootload(self, now: int, message: management.Bootload, source: Source) -> None:
        self._obey(Command.BOOTLOAD, message.module)

    def _obey(self, command: Command, module: str) -> None:
        if module == self._module:
            self._outbox.tell(Obey(command))


def _restarted(before: int, after: int) -> bool:
    """Whether a module started anew between two ALIVEs: only a start changes its mode or ends a STOP."""
    return bool((before ^ after) & _RESTART or before & ~after & management.FLAG_STOPPED)


def _as_heard(info: ModuleInfo) -> tuple[Hashable, ...]:
    return (info.flags, info.instance, info.observer, info.lease, info.hops, info.source)
