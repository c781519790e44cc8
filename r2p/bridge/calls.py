"""Messages of r2p's own services across a gateway: each to the one link behind which its module is.

They follow the tree as everything else, so there is no loop. Nothing about a call is remembered: an answer finds its
caller as a request finds its server, by the instance of the module. On a bus all gateways receive a message; only the
one behind which the module is passes it on.
"""

from r2p.bridge.forwarding import HOPS_MAX, BridgePort
from r2p.bridge.options import Policy
from r2p.clock import Clock
from r2p.codecs import own_services
from r2p.codecs.own_services import OwnCall
from r2p.protocols.discovery.events import ModuleInfo
from r2p.transports.link import Link


class CallRelay:
    """The relay of calls and answers between the ports of a gateway, by the name of the link."""

    def __init__(self, ports: dict[str, BridgePort], policy: Policy, clock: Clock) -> None:
        self._ports = ports
        self._policy = policy
        self._clock = clock
        self._instances: dict[str, tuple[int, dict[int, ModuleInfo]]] = {}
        """Modules by instance, for each link with the generation of its discovery."""

    def detach(self, link: str) -> None:
        """Forget a link that the gateway no longer has."""
        self._instances.pop(link, None)

    def is_read_only(self, link: Link) -> bool:
        """Return whether nothing may go onto a link, so that nothing may be changed from there either."""
        return self._policy.is_read_only(link.name)

    def forward(self, link: Link, call: OwnCall, data: bytes) -> None:
        """Pass on a message that came by a link and is for another module, or count why not."""
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
        elif self._policy.call_denied(port.name, target.name, changes=call.changes, is_request=call.is_request):
            port.count_dropped("call refused")
        else:
            info = self._modules(target)[call.target]
            target.link.calls.send(own_services.with_hops(data, call.hops + 1), info.source)

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
