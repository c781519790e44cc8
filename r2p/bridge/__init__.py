"""A gateway joins the links of a module, so that they are one network.

A gateway has no topics of its own. On each link it publishes the topics published elsewhere, and subscribes to those
subscribed elsewhere; so subscriptions travel through it, also from gateway to gateway, and only subscribed topics are
sent. It never decodes a message. The gateways agree on where each of them forwards (`r2p.protocols.bridge`).

Read `forwarding` first (a message's way through), then `routing` (which routes there are) and `bridge` (ports, tree,
management messages). `options` has the rules for passing and changing messages, `directory_relay` passes on modules and
nodes, `orders` STOP and the like. `multihoming` is for modules with several links that are not gateways.
"""

from r2p.bridge.bridge import Bridge, GatewayStatistics, PortStatistics, RouteStatistics
from r2p.bridge.multihoming import MultihomedModule
from r2p.bridge.options import BridgeOptions, ClassOf

__all__ = [
    "Bridge",
    "BridgeOptions",
    "ClassOf",
    "GatewayStatistics",
    "MultihomedModule",
    "PortStatistics",
    "RouteStatistics",
]
