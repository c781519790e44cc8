"""r2p: typed publish/subscribe from the microcontroller on the CAN bus to the PC in the next town.

Nodes are coroutine functions that exchange typed messages on topics; modules run nodes and join networks by transports:

    async def blink(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led)
        async for _ in node.every(0.5):
            await leds.publish(Led(led=3, value=1))

    r2p.run(blink, via="tcp:192.168.0.10:23")
"""

import r2p.startup as _startup  # noqa: F401 - first: Ctrl-C may come during what follows

# isort: split
import importlib
from typing import TYPE_CHECKING

from r2p.version import __version__ as __version__

if TYPE_CHECKING:
    from r2p.bridge import BridgeOptions, ClassOf, GatewayStatistics, PortStatistics, RouteStatistics
    from r2p.errors import (
        BagError,
        Broken,
        Closed,
        Deadlock,
        DecodeError,
        Error,
        InvalidName,
        MessageError,
        NameTooLong,
        NodeCrashed,
        NoServer,
        ParameterError,
        ServiceBusy,
        ServiceError,
        TooLong,
        TransportError,
        TypeMismatch,
        WebError,
    )
    from r2p.messages import (
        Array,
        Duration,
        Layout,
        Len,
        Max,
        Message,
        Timestamp,
        f32,
        f64,
        i8,
        i16,
        i32,
        i64,
        layout,
        u8,
        u16,
        u32,
        u64,
    )
    from r2p.modules.graph import Endpoint, ModuleView, NetworkView, TopicView
    from r2p.modules.module import Module
    from r2p.modules.node_messages import NodeInfo, NodeList
    from r2p.modules.remote_nodes import RemoteNodes, RemoteSwap
    from r2p.modules.runner import run, run_main
    from r2p.modules.statistics import (
        ForwardedTopic,
        LinkStatistics,
        ModuleStatistics,
        NodeStatistics,
        PublisherStatistics,
        ReasonCount,
        ServiceStatistics,
        SubscriberStatistics,
        TopicOnLink,
    )
    from r2p.modules.supervisor import NodeFunction, name_of
    from r2p.modules.swap import SwapLimits, SwapResult, TopicPause
    from r2p.parameters.definition import ParameterInfo
    from r2p.parameters.parameter import Parameter
    from r2p.parameters.registry import ModuleParameters
    from r2p.protocols.discovery.events import Command, Mismatched, ModuleChanged, ModuleGone, ModuleInfo, NameConflict
    from r2p.recording.bag import Bag
    from r2p.recording.recorder import Recorder
    from r2p.recording.recording_files import RecordingOptions
    from r2p.runtime.events import LinkDown, LinkNotice, LinkUp, LinkWaits, Listening, ModuleEvent
    from r2p.runtime.network_time import NetworkTick, Sync
    from r2p.runtime.node import Node
    from r2p.runtime.publishers import PeriodicPublisher, Publisher, SporadicPublisher
    from r2p.runtime.qos import Missed, NonRealTime, Periodic, Sporadic
    from r2p.runtime.sample import PublisherClass, Sample, Source
    from r2p.runtime.subscriber import Subscriber
    from r2p.runtime.ticks import Tick
    from r2p.services.client import ServiceClient
    from r2p.services.definition import Service
    from r2p.services.server import ServiceServer

__all__ = [
    "Array",
    "Bag",
    "BagError",
    "BridgeOptions",
    "Broken",
    "ClassOf",
    "Closed",
    "Command",
    "Deadlock",
    "DecodeError",
    "Duration",
    "Endpoint",
    "Error",
    "ForwardedTopic",
    "GatewayStatistics",
    "InvalidName",
    "Layout",
    "Len",
    "LinkDown",
    "LinkNotice",
    "LinkStatistics",
    "LinkUp",
    "LinkWaits",
    "Listening",
    "Max",
    "Message",
    "MessageError",
    "Mismatched",
    "Missed",
    "Module",
    "ModuleChanged",
    "ModuleEvent",
    "ModuleGone",
    "ModuleInfo",
    "ModuleParameters",
    "ModuleStatistics",
    "ModuleView",
    "NameConflict",
    "NameTooLong",
    "NetworkTick",
    "NetworkView",
    "NoServer",
    "Node",
    "NodeCrashed",
    "NodeFunction",
    "NodeInfo",
    "NodeList",
    "NodeStatistics",
    "NonRealTime",
    "Parameter",
    "ParameterError",
    "ParameterInfo",
    "Periodic",
    "PeriodicPublisher",
    "PortStatistics",
    "Publisher",
    "PublisherClass",
    "PublisherStatistics",
    "ReasonCount",
    "Recorder",
    "RecordingOptions",
    "RemoteNodes",
    "RemoteSwap",
    "RouteStatistics",
    "Sample",
    "Service",
    "ServiceBusy",
    "ServiceClient",
    "ServiceError",
    "ServiceServer",
    "ServiceStatistics",
    "Source",
    "Sporadic",
    "SporadicPublisher",
    "Subscriber",
    "SubscriberStatistics",
    "SwapLimits",
    "SwapResult",
    "Sync",
    "Tick",
    "Timestamp",
    "TooLong",
    "TopicOnLink",
    "TopicPause",
    "TopicView",
    "TransportError",
    "TypeMismatch",
    "WebError",
    "f32",
    "f64",
    "i8",
    "i16",
    "i32",
    "i64",
    "layout",
    "name_of",
    "run",
    "run_main",
    "u8",
    "u16",
    "u32",
    "u64",
]

# What type checkers see above, by module. Each is imported when one of its names is used first: a program that needs
# only messages or codecs imports no more, and what records bags needs an extra, which most programs do not have.
_ORIGINS = {
    "r2p.bridge": "BridgeOptions ClassOf GatewayStatistics PortStatistics RouteStatistics",
    "r2p.errors": (
        "BagError Broken Closed Deadlock DecodeError Error InvalidName MessageError NameTooLong NodeCrashed "
        "NoServer ParameterError ServiceBusy ServiceError TooLong TransportError TypeMismatch WebError"
    ),
    "r2p.messages": "Array Duration Layout Len Max Message Timestamp f32 f64 i8 i16 i32 i64 layout u8 u16 u32 u64",
    "r2p.modules.graph": "Endpoint ModuleView NetworkView TopicView",
    "r2p.modules.module": "Module",
    "r2p.modules.node_messages": "NodeInfo NodeList",
    "r2p.modules.remote_nodes": "RemoteNodes RemoteSwap",
    "r2p.modules.runner": "run run_main",
    "r2p.modules.statistics": (
        "ForwardedTopic LinkStatistics ModuleStatistics NodeStatistics PublisherStatistics ReasonCount "
        "ServiceStatistics SubscriberStatistics TopicOnLink"
    ),
    "r2p.modules.supervisor": "NodeFunction name_of",
    "r2p.modules.swap": "SwapLimits SwapResult TopicPause",
    "r2p.parameters.definition": "ParameterInfo",
    "r2p.parameters.parameter": "Parameter",
    "r2p.parameters.registry": "ModuleParameters",
    "r2p.protocols.discovery.events": "Command Mismatched ModuleChanged ModuleGone ModuleInfo NameConflict",
    "r2p.recording.bag": "Bag",
    "r2p.recording.recorder": "Recorder",
    "r2p.recording.recording_files": "RecordingOptions",
    "r2p.runtime.events": "LinkDown LinkNotice LinkUp LinkWaits Listening ModuleEvent",
    "r2p.runtime.network_time": "NetworkTick Sync",
    "r2p.runtime.node": "Node",
    "r2p.runtime.publishers": "PeriodicPublisher Publisher SporadicPublisher",
    "r2p.runtime.qos": "Missed NonRealTime Periodic Sporadic",
    "r2p.runtime.sample": "PublisherClass Sample Source",
    "r2p.runtime.subscriber": "Subscriber",
    "r2p.runtime.ticks": "Tick",
    "r2p.services.client": "ServiceClient",
    "r2p.services.definition": "Service",
    "r2p.services.server": "ServiceServer",
}
_SUBMODULES = ("errors", "messages", "msg")
_MODULE_OF = {name: module for module, names in _ORIGINS.items() for name in names.split()}

if not TYPE_CHECKING:  # with it, type checkers would accept any name

    def __getattr__(name: str) -> object:
        """Import what a program uses for the first time. Raises BagError for recordings, if their extra is missing."""
        if name in _SUBMODULES:
            return importlib.import_module(f"{__name__}.{name}")
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found: object = getattr(importlib.import_module(_MODULE_OF[name]), name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *_SUBMODULES, *__all__})
