"""A gateway: what joins the links of a module, so that they are one network.

A gateway has no topics of its own. On each link it publishes what others offer elsewhere, and subscribes what others
want elsewhere; so subscriptions travel through it, also from gateway to gateway, and only what somebody wants is sent.
It never decodes a message. Where it forwards at all is agreed with the other gateways (`r2p.protocols.bridge`).

    link  ->  BridgedTopic.deliver  ->  Way  ->  outlet of another link

`Bridge` owns the ports and the tree, `Relays` keeps the topics up to date, `Presences` tells of modules and nodes.
"""

from r2p.bridge.bridge import Bridge
from r2p.bridge.multihoming import MultihomedModule
from r2p.bridge.options import BridgeOptions, ClassOf
from r2p.bridge.port import GatewayStatistics, PortStatistics, WayStatistics

__all__ = [
    "Bridge",
    "BridgeOptions",
    "ClassOf",
    "GatewayStatistics",
    "MultihomedModule",
    "PortStatistics",
    "WayStatistics",
]
