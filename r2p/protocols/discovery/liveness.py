"""Track the modules on one link: those that come, go and restart, two with one name, and echoes of this module.

Firmware is known by its ALIVE only. It never says good-bye, and is remembered for good. An r2p module also says HELLO
with the random number of its start (its instance), which distinguishes a restart from a second module of the same name.
"""

from typing import TypeVar

import msgspec

from r2p.codecs import management
from r2p.names import module_alias
from r2p.protocols.discovery.aliases import ModuleAliases
from r2p.protocols.discovery.announcer import Announcer
from r2p.protocols.discovery.directory import Directory, lease_in
from r2p.protocols.discovery.events import (
    KIND_MODULE,
    AliasConflict,
    EchoDetected,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    NameConflict,
    PeerAddress,
)
from r2p.protocols.discovery.negotiation import SubscriptionNegotiation
from r2p.units import MILLISECOND, SECOND

_REPORT_INTERVAL = 5 * SECOND
"""Ns between two reports of one conflict, or of an echo."""
_UNNAMED_MAX = 256
"""Remembered aliases of modules without a name."""
_REPORTED_MAX = 64
"""Remembered names with a conflict; further ones are only counted."""
_ECHO_INTERVAL = 10 * SECOND
"""Ns after an echo in which the line is expected to echo again."""
_SWAPS_OF_TWO = 3
"""A name that goes back and forth between two instances this often belongs to two modules."""
_M = TypeVar("_M", management.Alive, management.Hello)
_RESTART = management.FLAG_REBOOTED | management.FLAG_BOOT


class PeerLiveness:
    """The modules of one link."""

    def __init__(self, announcer: Announcer, negotiation: SubscriptionNegotiation, directory: Directory) -> None:
        self._module = announcer.module
        self._instance = announcer.instance
        self._announcer = announcer
        self._negotiation = negotiation
        self._directory = directory
        self._timers = directory.timers
        self._outbox = announcer.outbox
        self._counts = directory.counts
        self.aliases = ModuleAliases(announcer.module, directory.counts)
        """The names of modules that are too long for a message."""
        self._unnamed: dict[str, None] = {}
        """Aliases of modules whose names have not been received yet."""
        self._echoing_until = 0
        self._next_report: dict[str, int] = {}

    # Messages

    def name(self, now: int, message: management.Name, source: PeerAddress) -> None:
        """Handle NAME: a module known by its alias gets its name."""
        name = self.aliases.receive(message)
        if self.aliases.name_of(message.alias) != message.alias:
            self._unnamed.pop(message.alias, None)
        info = self._directory.modules.get(message.alias)
        if name is not None and (other := self.aliases.other_name(name)):
            if self._admit_report(now, f"alias {message.alias}"):
                self._outbox.emit(AliasConflict(KIND_MODULE, message.alias, other, name))
        elif name is not None and info is not None and (info.hops or not info.r2p):
            self._remove(now, info)
            self._enter(now, None, msgspec.structs.replace(info, name=name))

    def alive(self, now: int, message: management.Alive, source: PeerAddress) -> None:
        """Handle ALIVE: the state of any module."""
        known = self._directory.modules.get(message.module)
        if known is not None and known.flags == message.flags and self._is_settled(known):
            self._heard_again(now, known, known.lease)
            return
        if not self._is_possible(message.module):
            return
        if not self._is_short(message.module):
            message = self._with_name(message)
        if message.module in self._unnamed:
            return
        if message.module.startswith("_"):
            return  # a gateway's probe for loops: only tools have such names, and they send no ALIVE
        if message.module == self._module and not self._report_namesake(now):
            return
        before, info = self._directory.read_alive(now, message, source)
        # Firmware has no instance: a restart shows in its flags only, if at all.
        if before is not None and _restarted(before.flags, info.flags):
            self._negotiation.restarted(source)
        self._enter(now, before, info)

    def hello(self, now: int, message: management.Hello, source: PeerAddress) -> None:
        """Handle HELLO: an r2p module, maybe this one."""
        known = self._directory.modules.get(message.module)
        if known is not None and known.is_repeated_by(message, source) and self._is_settled(known):
            info = self._heard_again(now, known, lease_in(message))
            self._negotiation.module_found(now, info, is_new=False)
            return
        if not self._is_possible(message.module):
            return
        is_alias = bool(message.flags & management.HELLO_ALIAS)
        if is_alias or message.hops:  # r2p before the flag gave long names only to modules behind gateways
            message = self._with_name(message)
        if is_alias and message.module == module_alias(message.module):
            self._wait_for_name(message.module)
            return
        if (message.module, message.instance) == (self._module, self._instance):
            if not message.hops:  # else a gateway does not know yet that this module is on both sides of it
                self._echoed(now)
        elif self._is_nearer(message):
            pass  # a gateway may not know yet that the module is on both sides of it
        elif message.flags & management.HELLO_LEAVING:
            self._leaving(now, message, source)
        else:
            self._present(now, message, source)

    def endpoint(self, now: int, message: management.Endpoint, source: PeerAddress) -> None:
        """Handle ENDPOINT: a publisher or subscriber of a remote node."""
        if message.instance != self._instance:
            self._directory.enter_endpoint(now, message)

    def conflict(self, now: int, message: management.Conflict, source: PeerAddress) -> None:
        """Handle CONFLICT: a peer that hears more modules found another one of this module's name."""
        instances = (message.instance_a, message.instance_b)
        if message.module == module_alias(self._module) and self._instance in instances:
            self._report_conflict(now, self._module, *instances)

    # Time and the link

    def drop_echo(self, now: int, data: bytes) -> bool:
        """Count a message of this module that the line returned; return False for any other.

        The HELLO of this module shows that the line does so.
        """
        if now >= self._echoing_until or not self._outbox.pop_echo(data):
            return False
        self._echoing_until = now + _ECHO_INTERVAL
        self._counts["echo"] += 1
        return True

    def expired(self, now: int, name: str) -> None:
        """Remove an r2p module that was silent for its lease, or for this module's own, if they answer one by one."""
        info = self._directory.modules[name]
        if self._directory.has_addresses and not info.hops:
            # Its rounds have become longer with each new module, like those here: it says so only with the next one.
            end = info.last_heard + self._announcer.lease * MILLISECOND
            if end > now:
                self._timers.set(("module", name), end)
                return
        self._remove(now, info, silent=True)

    def link_down(self, now: int) -> None:
        """Remove all r2p modules."""
        for key in list(self._directory.endpoints):
            self._directory.forget_endpoint(key)
        self._echoing_until = 0
        for info in [info for info in self._directory.modules.values() if info.r2p]:
            self._remove(now, info)

    def _is_settled(self, info: ModuleInfo) -> bool:
        """Return whether a module on the link itself has this very name, and no other module has."""
        return info.r2p and not info.hops and info.name != self._module and info.name not in self._unnamed

    # Names

    def module_behind(self, alias: str) -> str:
        """Return the name that an alias stands for; the alias itself if it is a name, or its name is unknown."""
        return self.aliases.name_of(alias)

    def other_module(self, name: str) -> str:
        """Return another module that has the same alias; empty without one."""
        return self.aliases.other_name(name)

    def _is_possible(self, name: str) -> bool:
        if "/" not in name:
            return True
        self._counts["impossible name"] += 1  # names with a prefix travel as an alias
        return False

    def _with_name(self, message: _M) -> _M:
        name = self.aliases.name_of(message.module)
        return message if name == message.module else msgspec.structs.replace(message, module=name)

    def _is_short(self, name: str) -> bool:
        """Return whether a module on the link itself has this very name, whatever it may be the alias of."""
        info = self._directory.modules.get(name)
        return info is not None and info.r2p and not info.hops

    def _wait_for_name(self, alias: str) -> None:
        """Note a module whose name is lost, or on its way; it is repeated, as HELLO is."""
        self._unnamed[alias] = None
        if len(self._unnamed) > _UNNAMED_MAX:
            del self._unnamed[next(iter(self._unnamed))]

    def _is_nearer(self, message: management.Hello) -> bool:
        """Return whether a module of this name is known to be nearer than a gateway says. The gateway may not have
        learnt yet that the module has restarted.
        """
        if message.module == self._module:
            return message.hops > 0
        info = self._directory.modules.get(message.module)
        return info is not None and info.r2p and info.hops < message.hops

    def _report_namesake(self, now: int) -> bool:
        """Report an ALIVE with this module's own name, unless it is an echo; return whether to remember its sender."""
        if now < self._echoing_until:
            self._counts["echo"] += 1
            return False
        namesake = self._directory.modules.get(self._module)
        self._report_conflict(now, self._module, self._instance, namesake.instance if namesake is not None else None)
        return namesake is not None

    # Modules

    def _present(self, now: int, message: management.Hello, source: PeerAddress) -> None:
        """Enter an r2p module that introduces itself, for the first time or again."""
        # The previous information has to be read first: `_enter` replaces it.
        known_start = self._directory.was_before(message.module, message.instance)
        before, info = self._directory.read_hello(now, message, source)
        self._look_for_namesakes(now, before, message)
        is_new = not known_start and (before is None or before.instance != info.instance)
        # Before `module_found`: the end at its old address must not affect the new one.
        if before is not None and (before.source, before.hops) != (info.source, info.hops):
            self._negotiation.module_gone(now, before)
        if message.hops == 0:
            self._negotiation.module_found(now, info, is_new=is_new)
        self._enter(now, before, info)
        # After `_enter`: the rate of repetition depends on the number of modules.
        asks = bool(message.flags & management.HELLO_QUERY)
        if self._directory.has_addresses and message.hops == 0:  # there each new module asks
            if asks:
                self._announcer.answer(source)
        elif is_new or asks:
            self._announcer.repeat_all(now, tool=bool(message.flags & management.HELLO_TOOL))

    def _look_for_namesakes(self, now: int, before: ModuleInfo | None, message: management.Hello) -> None:
        swaps = self._directory.count_swaps(now, before, message.instance)
        if message.module == self._module:
            self._report_conflict(now, message.module, self._instance, message.instance)
        elif before is not None and swaps >= _SWAPS_OF_TWO:
            self._report_conflict(now, message.module, before.instance, message.instance)

    def _leaving(self, now: int, message: management.Hello, source: PeerAddress) -> None:
        info = self._directory.modules.get(message.module)
        if info is not None and info.instance == message.instance:
            self._remove(now, info)
        elif message.hops == 0:
            self._negotiation.unknown_left(now, source)

    def _enter(self, now: int, before: ModuleInfo | None, info: ModuleInfo) -> None:
        """Enter a module's information, and report it unless it only shows that the module lives."""
        forgotten = self._directory.enter(info)  # made room for this one: counts as gone
        if info.r2p:
            self._timers.set(("module", info.name), now + info.lease)
        if before is None or before.differs(info):
            self._outbox.emit(ModuleChanged(info))
        if forgotten is not None and forgotten.r2p:
            self._remove(now, forgotten)
        self._announcer.update_r2p()

    def _heard_again(self, now: int, info: ModuleInfo, lease: int) -> ModuleInfo:
        """Renew the lease of a module that only shows that it lives; return its new information."""
        self._timers.set(("module", info.name), now + lease)
        return self._directory.refresh(now, info, lease)

    def _remove(self, now: int, info: ModuleInfo, *, silent: bool = False) -> None:
        self._directory.remove(info)
        self._timers.clear(("module", info.name))
        self._outbox.emit(ModuleGone(info, silent))
        self._negotiation.module_gone(now, info)
        self._announcer.update_r2p()

    # Reports

    def _echoed(self, now: int) -> None:
        self._counts["echo"] += 1
        self._echoing_until = now + _ECHO_INTERVAL
        if self._admit_report(now, ""):
            self._outbox.emit(EchoDetected())

    def _report_conflict(self, now: int, module: str, instance_a: int | None, instance_b: int | None) -> None:
        if self._admit_report(now, module):
            self._outbox.emit(NameConflict(module, instance_a, instance_b))

    def _admit_report(self, now: int, subject: str) -> bool:
        """Decide whether to report a conflict now, and note the report; '': an echo."""
        if now < self._next_report.get(subject, now):
            return False
        if len(self._next_report) >= _REPORTED_MAX:
            self._next_report = {each: at for each, at in self._next_report.items() if at > now}
            if len(self._next_report) >= _REPORTED_MAX:
                self._counts["conflicts not reported"] += 1
                return False
        self._next_report[subject] = now + _REPORT_INTERVAL
        return True


def _restarted(before: int, after: int) -> bool:
    """Return whether a module started anew between two ALIVEs: only a start changes its mode or ends a STOP."""
    return bool((before ^ after) & _RESTART or before & ~after & management.FLAG_STOPPED)
