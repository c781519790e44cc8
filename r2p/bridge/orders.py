"""Orders for modules (STOP, REBOOT, BOOTLOAD) across a gateway: whether each passes, and to which module.

An order names a module by its alias of 7 characters, on links with a prefix by the alias of the name with the prefix.
So `ModuleNames` finds the module, or reports that there are two. Refused orders are logged, and their sender gets a
DENIED.
"""

import msgspec

from r2p.bridge.directory_relay import DirectoryRelay
from r2p.bridge.forwarding import BridgePort
from r2p.bridge.options import Policy
from r2p.clock import Clock
from r2p.codecs import management
from r2p.log_lines import get_logger
from r2p.names import module_alias
from r2p.units import SECOND

logger = get_logger("r2p.bridge")

_DENIED_APART = SECOND // 5  # ns between two DENIED on one link
_AMBIGUOUS_MAX = 100  # aliases of two modules that are remembered, so that each is logged once

_REASONS = {
    management.DENIED_CONTROL: "see --allow-control",
    management.DENIED_READ_ONLY: "see --read-only",
    management.DENIED_BOOT: "the module is in boot mode, where a STOP hangs it",
    management.DENIED_NO_KEY: "its sender lacks this link's key",
    management.DENIED_OTHER_KEY: "its sender has another key than this link",
    management.DENIED_OPEN_LINK: "its link has no key, and the module's has one",
}


class ModuleNames:
    """The names of modules on each link of a gateway."""

    def __init__(self, policy: Policy, directory: DirectoryRelay) -> None:
        self._policy = policy
        self._directory = directory
        self._ambiguous: set[str] = set()

    def to_canonical(self, alias: str, link: str) -> str | None:
        """Return the module that an order on this link names; None if it is not the robot's, or ambiguous."""
        prefix = self._policy.prefix(link)
        if prefix:
            found = [name for name in self._directory.own_modules() if module_alias(prefix + name) == alias]
        else:
            found = self._directory.modules_behind(alias)
        if len(found) > 1:
            self._log_ambiguous(alias, prefix, found)
            return None
        if found:
            return found[0]
        if not prefix:
            return alias
        return alias.removeprefix(prefix) if alias.startswith(prefix) else None

    def to_link_name(self, name: str, link: str) -> str | None:
        """Return the name of a module on a link; None if it is not visible there."""
        foreign = self._directory.foreign_link(name)
        if foreign:
            return name if link == foreign or not self._policy.prefix(link) else None
        return self._policy.prefix(link) + name

    def translate(self, name: str, link: str, other: str) -> str | None:
        """Return a module's name on another link, by its name on one; None if the two must not be confused."""
        module = self._policy.module_to_canonical(name, link)
        if module is None or module[1]:
            return None
        return self._policy.module_to_link_name(module[0], other, foreign=False)

    def _log_ambiguous(self, alias: str, prefix: str, found: list[str]) -> None:
        if alias not in self._ambiguous and len(self._ambiguous) < _AMBIGUOUS_MAX:
            self._ambiguous.add(alias)
            names = " and ".join(prefix + each for each in sorted(found))
            logger.error("%s have the same alias %s: orders reach neither; rename one", names, alias)


class OrderRelay:
    """The relay of orders and DENIED between the ports of the gateway `module`."""

    def __init__(
        self, module: str, clock: Clock, ports: dict[str, BridgePort], policy: Policy, names: ModuleNames
    ) -> None:
        self._module = module
        self._clock = clock
        self._ports = ports
        self._policy = policy
        self._names = names

    def forward(self, port: BridgePort, order: management.Order) -> bool:
        """Forward an order; return True if it is for this module, which does not obey it."""
        harmless = isinstance(order, management.Stop)
        if order.module == module_alias(self._module):
            reason = self._policy.order_denied(port.name, None, harmless=harmless)
            if reason:
                self._refuse(port, order, reason, known=True)
                return True
        name = self._names.to_canonical(order.module, port.name)
        if name is not None:
            self._forward_to(name, port, order)
        return False

    def _forward_to(self, name: str, port: BridgePort, order: management.Order) -> None:
        """Send the order to all links that it may go to, as the module may be anywhere. Refuse it if the module is
        known behind a link that it may not go to, or if it may go nowhere.
        """
        passed, refused, known = False, 0, False
        for other in self._open_from(port):
            link_name = self._names.to_link_name(name, other.name)
            if link_name is None:
                continue
            reason = self._denied(port, other, order, link_name)
            if not reason:
                passed = True
                named = msgspec.structs.replace(order, module=module_alias(link_name))
                other.link.send_management(management.encode(named), urgent=True)
            elif not known:
                known = link_name in other.link.discovery.modules
                refused = reason if known else refused or reason
        if refused and (known or not passed):
            self._refuse(port, order, refused, known=known)

    def refuse(self, port: BridgePort, order: management.Order, reason: int) -> None:
        """Refuse an order that came without the key of its link; answer if it was for this module, or one behind it."""
        known = order.module == module_alias(self._module)
        name = None if known else self._names.to_canonical(order.module, port.name)
        if name is not None:
            others = (each for each in self._ports.values() if each is not port)
            known = any(self._names.to_link_name(name, each.name) in each.link.discovery.modules for each in others)
        self._refuse(port, order, reason, known=known)

    def forward_denial(self, port: BridgePort, denied: management.Denied) -> None:
        """Forward a DENIED to all links: the sender of the order may be anywhere."""
        name = self._names.to_canonical(denied.module, port.name)
        if name is None:
            return
        for other in self._open_from(port):
            link_name = self._names.to_link_name(name, other.name)
            if link_name is not None:
                named = msgspec.structs.replace(denied, module=module_alias(link_name))
                other.link.write_management(management.encode(named))

    def _open_from(self, port: BridgePort) -> list[BridgePort]:
        """Yield the ports to which messages from this one may be forwarded now."""
        now = self._clock.monotonic()
        if now >= port.tree_port.forwards_until:
            port.count_dropped("converging")
            return []
        others = [each for each in self._ports.values() if each is not port and each.link.up]
        return [each for each in others if now < each.tree_port.forwards_until]

    def _denied(self, port: BridgePort, other: BridgePort, order: management.Order, link_name: str) -> int:
        """Return why an order may not go to another link, where its module has this name (DENIED_..., 0: it may)."""
        harmless = isinstance(order, management.Stop)
        if harmless and other.link.discovery.is_booting(link_name):
            return management.DENIED_BOOT
        if other.link.guard is not None and port.link.guard is None:
            return management.DENIED_OPEN_LINK  # this gateway does not lend its key
        return self._policy.order_denied(port.name, other.name, harmless=harmless)

    def _refuse(self, port: BridgePort, order: management.Order, reason: int, *, known: bool) -> None:
        """Count the order, log it once in a while, and answer if it is for a module that is `known`."""
        now = self._clock.monotonic()
        port.count_dropped("order refused")
        more = port.refusal_lines.suffix("", now)
        if more is not None:
            logger.warning(
                "%s from %s is refused: %s (%d orders refused so far)%s",
                type(order).__name__.upper(),
                port.name,
                _REASONS[reason],
                port.dropped["order refused"],
                more,
            )
        if known and now >= port.denied_at + _DENIED_APART:
            port.denied_at = now
            denied = management.Denied(module_alias(self._module), order.module, management.order_type(order), reason)
            port.link.write_management(management.encode(denied))
