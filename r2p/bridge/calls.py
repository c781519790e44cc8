"""Messages of r2p's own services across a gateway: each to the one link behind which its module is.

They follow the tree as everything else, so there is no loop. Nothing about a call is remembered: an answer finds its
caller as a request finds its server, by the instance of the module. On a bus all gateways receive a message; only the
one behind which the module is passes it on, or refuses it: then it answers in the place of the module.
"""

from collections.abc import Hashable

from r2p.bridge.forwarding import HOPS_MAX, BridgePort
from r2p.bridge.options import Policy
from r2p.clock import Clock
from r2p.codecs import own_services
from r2p.codecs.management import DENIED_CONTROL, DENIED_READ_ONLY
from r2p.codecs.own_services import MESSAGE_MAX, OwnCall
from r2p.codecs.services import Kind
from r2p.log_lines import get_logger
from r2p.protocols.discovery.events import ModuleInfo
from r2p.transports.link import Link
from r2p.transports.url import is_ros, scheme_of

logger = get_logger("r2p.bridge")


class CallRelay:
    """The relay of calls and answers between the ports of the gateway `module`, by the name of the link."""

    def __init__(self, module: str, ports: dict[str, BridgePort], policy: Policy, clock: Clock) -> None:
        self._module = module
        self._ports = ports
        self._policy = policy
        self._clock = clock
        self._instances: dict[str, tuple[int, dict[int, ModuleInfo]]] = {}
        """Modules by instance, for each link with the generation of its discovery."""

    def detach(self, link: str) -> None:
        """Forget a link that the gateway no longer has."""
        self._instances.pop(link, None)

    def is_read_only(self, link: Link) -> bool:
        """Return whether a link is read-only: it carries no messages out, and no changes in."""
        return self._policy.is_read_only(link.name)

    def passes_on(self, link: Link, call: OwnCall) -> bool:
        """Return whether it is this gateway that passes on a message of a link, or refuses it."""
        return self._way_to(self._ports[link.name], call.target, self._clock.monotonic()) is not None

    def forward(self, link: Link, call: OwnCall, data: bytes, source: Hashable) -> None:
        """Pass on a message that came by a link, from this address, for another module; or count why not."""
        port, now = self._ports[link.name], self._clock.monotonic()
        if now >= port.tree_port.forwards_until:
            if port.in_tree:  # else it comes here by another link, or another gateway passes it on
                port.count_dropped("converging")
            return
        target = self._way_to(port, call.target, now)
        if target is None:
            if link.point_to_point:  # else another gateway passes it on, or its module has received it
                port.count_dropped("call without route")
        elif call.hops >= HOPS_MAX:
            port.count_dropped("too many hops")
        elif len(data) > MESSAGE_MAX:  # only asked for where no gateway is on the way
            port.count_dropped("call too long")
        elif refusal := self._refusal(port, target, call):
            self._refuse(port, call, refusal, source)
        else:
            info = self._modules(target)[call.target]
            target.link.calls.send(own_services.with_hops(data, call.hops + 1), info.source)

    def _refusal(self, source: BridgePort, target: BridgePort, call: OwnCall) -> str:
        """Return why a message may not go from one port to another; empty if it may.

        What only asks passes where its answer may come back. What changes something needs permission besides.
        """
        gateway, here, there = self._module, scheme_of(source.name), scheme_of(target.name)
        if self._policy.is_read_only((source if call.is_request else target).name):
            return f"gateway {gateway} passes nothing on to {here}: it is started with --read-only for that link"
        if not (call.is_request and call.changes):
            return ""
        sealed = source.link.guard is not None
        if target.link.guard is not None and not sealed:  # this gateway does not lend its key
            lacks = f"which has a key: give {here} one (?key=FILE)"
            return f"gateway {gateway} passes no changes from {here} to {there}, {lacks}"
        reason = self._policy.change_denied(source.name, target.name, sealed=sealed)
        if reason == DENIED_READ_ONLY:
            return f"gateway {gateway} lets no changes onto {there}: it is started with --read-only for that link"
        if reason == DENIED_CONTROL:
            return permission_text(f"gateway {gateway}", here)
        return ""

    def _refuse(self, port: BridgePort, call: OwnCall, refusal: str, source: Hashable) -> None:
        """Count a message that may not pass, log it once in a while, and answer it if it is a request."""
        port.count_dropped("change refused" if call.changes else "call refused")
        if call.header.kind is not Kind.REQUEST or port.link.calls.full:
            return
        if call.changes and (more := port.refusal_lines.suffix("changes", self._clock.monotonic())) is not None:
            logger.warning("link %s: %s%s", port.link.title, refusal, more)
        port.link.calls.send(own_services.refusal(call, refusal), source)

    def _way_to(self, port: BridgePort, instance: int, now: int) -> BridgePort | None:
        """Return the port behind which a module is, in the tree; None if it is on the side where the message came from,
        unknown, or not visible from there.
        """
        known = [
            (info.hops, each is not port, each)
            for each in self._ports.values()
            if now < each.tree_port.forwards_until and (info := self._modules(each).get(instance)) is not None
        ]
        if not known:
            return None
        _, is_other, found = min(known, key=lambda each: each[:2])
        return found if is_other and self._is_visible(found, instance, port) else None

    def _is_visible(self, target: BridgePort, instance: int, port: BridgePort) -> bool:
        """Return whether the gateway announces the module of one port on another one."""
        found = self._policy.module_to_canonical(self._modules(target)[instance].name, target.name)
        if found is None:
            return False
        name, foreign = found
        return self._policy.module_to_link_name(name, port.name, foreign=foreign) is not None

    def _modules(self, port: BridgePort) -> dict[int, ModuleInfo]:
        discovery = port.link.discovery
        generation, modules = self._instances.get(port.name, (-1, {}))
        if generation != discovery.generation:
            modules = {info.instance: info for info in discovery.modules.values() if info.instance is not None}
            self._instances[port.name] = discovery.generation, modules
        return modules


def permission_text(module: str, scheme: str) -> str:
    """Describe that a module needs permission for changes by a link of this scheme, and how to give it."""
    key = "" if is_ros(scheme) else ", or give the link a key (?key=FILE)"  # nodes of ROS know no keys
    return f"{module} refuses changes from {scheme}: start it with --allow-control{key}"
