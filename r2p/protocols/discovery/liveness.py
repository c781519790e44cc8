"""Who comes and goes on one link: modules, restarts, namesakes, and the echo of our own voice.

Firmware is known by its ALIVE only; it never says good-bye, and is remembered for good. An r2p module also says HELLO
with the random number of its start (its instance), which tells a restart from a namesake.
"""

from collections import Counter
from collections.abc import Hashable
from typing import TypeVar

import msgspec

from r2p.codecs import management
from r2p.protocols.discovery.announcer import Announcer
from r2p.protocols.discovery.directory import Directory
from r2p.protocols.discovery.events import (
    EchoDetected,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    NameConflict,
    Outbox,
    PeerAddress,
)
from r2p.protocols.discovery.negotiation import SubscriptionNegotiation
from r2p.protocols.discovery.peers import Aliases
from r2p.protocols.discovery.schedule import Schedule
from r2p.protocols.timers import KeyedTimers

_SECOND = 1_000_000_000
_TELL_AGAIN = 5 * _SECOND
"""Conflicts and echoes are told at most this often."""
_TOLD = 64
"""... and of so many names at a time."""
_ECHO_MEMORY = 10 * _SECOND
"""A line that echoed is expected to do so for this long."""
_SWAPS = 3
"""A name that goes back and forth between two instances this often belongs to two modules."""
_Shows = TypeVar("_Shows", management.Alive, management.Hello)
_RESTART = management.FLAG_REBOOTED | management.FLAG_BOOT


class PeerLiveness:
    """The modules of one link."""

    def __init__(
        self,
        module: str,
        instance: int,
        directory: Directory,
        exchange: SubscriptionNegotiation,
        announcer: Announcer,
        schedule: Schedule,
        timers: KeyedTimers,
        outbox: Outbox,
        counts: Counter[str],
    ) -> None:
        self._module = module
        self._instance = instance
        self._directory = directory
        self._exchange = exchange
        self._announcer = announcer
        self._schedule = schedule
        self._timers = timers
        self._outbox = outbox
        self._counts = counts
        self._aliases = Aliases()
        self._echoing_until = 0
        self._silent_until: dict[str, int] = {}

    def named(self, now: int, message: management.Name, source: PeerAddress) -> None:
        """What an alias stands for: a module that is known by it has its name from now on."""
        name = self._aliases.heard(message)
        info = self._directory.modules.get(message.alias)
        if name is not None and info is not None and (info.hops or not info.r2p):
            self._gone(now, info)
            self._keep(now, None, msgspec.structs.replace(info, name=name))

    def alive(self, now: int, message: management.Alive, source: PeerAddress) -> None:
        """Any module shows its state."""
        if "/" in message.module:  # those travel by their alias
            self._counts["impossible name"] += 1
            return
        message = self._with_name(message)
        if message.module.startswith("_"):
            return  # a gateway looks for loops: no module is called that, and tools send no ALIVE
        if message.module == self._module and not self._is_namesake(now):
            return
        before, info = self._directory.alive(now, message, source)
        if before is not None and _restarted(before.flags, info.flags):
            self._exchange.restarted(source)
        self._keep(now, before, info)

    def hello(self, now: int, message: management.Hello, source: PeerAddress) -> None:
        """An r2p module, maybe this very one."""
        if "/" in message.module:
            self._counts["impossible name"] += 1
            return
        message = self._with_name(message)
        if (message.module, message.instance) == (self._module, self._instance):
            if not message.hops:  # else a gateway does not know yet that we are on both sides of it
                self._heard_ourselves(now)
        elif self._is_nearer(message):
            pass  # a gateway may not know yet that the module is on both sides of it
        elif message.flags & management.HELLO_LEAVING:
            self._leaving(now, message, source)
        else:
            self._present(now, message, source)

    def _with_name(self, message: _Shows) -> _Shows:
        name = self._aliases.name_of(message.module)
        return message if name == message.module else msgspec.structs.replace(message, module=name)

    def _is_nearer(self, message: management.Hello) -> bool:
        """Whether a module of this name is known to be nearer than a gateway says: the latter may be its last start,
        of which others have not heard that it is over.
        """
        if message.module == self._module:
            return message.hops > 0
        info = self._directory.modules.get(message.module)
        return info is not None and info.r2p and info.hops < message.hops

    def endpoint(self, now: int, message: management.Endpoint, source: PeerAddress) -> None:
        """A publisher or subscriber of a remote node."""
        if message.instance != self._instance:
            self._directory.endpoint(now, message)

    def conflict(self, now: int, message: management.Conflict, source: PeerAddress) -> None:
        """Somebody who hears more than we do found a namesake of ours."""
        instances = (message.instance_a, message.instance_b)
        if message.module == self._module and self._instance in instances:
            self._tell_conflict(now, message.module, *instances)

    def is_echo(self, now: int, data: bytes) -> bool:
        """Whether a line that echoes gave back one of the last messages; our HELLO is how we know that it does."""
        if now >= self._echoing_until or not self._outbox.forget(data):
            return False
        self._echoing_until = now + _ECHO_MEMORY
        self._counts["echo"] += 1
        return True

    def expired(self, now: int, name: str) -> None:
        """An r2p module was silent for its lease."""
        self._gone(now, self._directory.modules[name], silent=True)

    def interrupted(self, now: int) -> None:
        """The link is down: nobody can be heard."""
        self._directory.forget_endpoints()
        self._echoing_until = 0
        for info in [info for info in self._directory.modules.values() if info.r2p]:
            self._gone(now, info)

    def _is_namesake(self, now: int) -> bool:
        """Our own name in an ALIVE: an echo, or somebody else's. Says whether that is a module to remember."""
        if now < self._echoing_until:
            self._counts["echo"] += 1
            return False
        namesake = self._directory.modules.get(self._module)
        self._tell_conflict(now, self._module, self._instance, namesake.instance if namesake is not None else None)
        return namesake is not None

    def _present(self, now: int, message: management.Hello, source: PeerAddress) -> None:
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
            tool = bool(message.flags & management.HELLO_TOOL)
            self._schedule.repeat(now, self._directory.r2p_modules, tool=tool)

    def _look_for_namesakes(self, now: int, before: ModuleInfo | None, message: management.Hello) -> None:
        swaps = self._directory.count_swaps(now, before, message.instance)
        if message.module == self._module:
            self._tell_conflict(now, message.module, self._instance, message.instance)
        elif before is not None and swaps >= _SWAPS:
            self._tell_conflict(now, message.module, before.instance, message.instance)

    def _leaving(self, now: int, message: management.Hello, source: PeerAddress) -> None:
        info = self._directory.modules.get(message.module)
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
            self._outbox.emit(ModuleChanged(info))
        if forgotten is not None and forgotten.r2p:
            self._gone(now, forgotten)
        self._announcer.follow(r2p=self._directory.knows_r2p)

    def _gone(self, now: int, info: ModuleInfo, *, silent: bool = False) -> None:
        self._directory.remove(info)
        self._timers.clear(("module", info.name))
        self._outbox.emit(ModuleGone(info, silent))
        self._exchange.moved_away(now, info)
        self._announcer.follow(r2p=self._directory.knows_r2p)

    def _heard_ourselves(self, now: int) -> None:
        self._counts["echo"] += 1
        self._echoing_until = now + _ECHO_MEMORY
        if self._may_tell(now, ""):
            self._outbox.emit(EchoDetected())

    def _tell_conflict(self, now: int, module: str, instance_a: int | None, instance_b: int | None) -> None:
        if self._may_tell(now, module):
            self._outbox.emit(NameConflict(module, instance_a, instance_b))

    def _may_tell(self, now: int, what: str) -> bool:
        if now < self._silent_until.get(what, now):
            return False
        if len(self._silent_until) >= _TOLD:
            self._silent_until = {each: until for each, until in self._silent_until.items() if until > now}
            if len(self._silent_until) >= _TOLD:
                self._counts["conflicts not told"] += 1
                return False
        self._silent_until[what] = now + _TELL_AGAIN
        return True


def _restarted(before: int, after: int) -> bool:
    """Whether a module started anew between two ALIVEs: only a start changes its mode or ends a STOP."""
    return bool((before ^ after) & _RESTART or before & ~after & management.FLAG_STOPPED)


def _as_heard(info: ModuleInfo) -> tuple[Hashable, ...]:
    return (info.flags, info.instance, info.observer, info.lease, info.hops, info.source)
