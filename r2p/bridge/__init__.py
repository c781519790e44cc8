"""A gateway joins the links of a module, so that they are one network.

A gateway has no topics of its own. On each link it publishes what is published elsewhere, and subscribes to what is
subscribed elsewhere; so subscriptions travel through it, also from gateway to gateway, and only what is subscribed is
sent. It never decodes a message. Where it forwards at all is agreed with the other gateways (`r2p.protocols.bridge`).

Read `forwarding` first (a message's way through), then `routing` (which routes there are) and `bridge` (ports, tree,
management messages). `options` says what may pass and how it is changed, `directory_relay` passes on modules and nodes,
`orders` STOP and the like. `multihoming` is for modules with several links that are not gateways.
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
