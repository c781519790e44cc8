"""A module's network as all clients share it: its channels, services and parameters, and what clients publish."""

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

import msgspec

from r2p.messages import Message
from r2p.modules.module import Module
from r2p.monitoring.topic_types import TypeFinder
from r2p.runtime.node import Node
from r2p.web.foxglove import channels, services
from r2p.web.foxglove.channels import ChannelTable
from r2p.web.foxglove.connections import ConnectionGraph, connections
from r2p.web.foxglove.parameters import NetworkParameters, ParametersChanged, Report
from r2p.web.foxglove.publishing import ClientPublications
from r2p.web.foxglove.services import ServiceTable

if TYPE_CHECKING:
    from r2p.modules.graph import TopicView

_NODE = "foxglove"


class FoxgloveOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What clients see and may do: `name` of the server; publish and call (`allow_publish`), set parameters
    (`allow_control`). `types` are those of topics that win over what publishers announce.
    """

    name: str = "r2p"
    allow_publish: bool = False
    allow_control: bool = False
    types: Mapping[str, type[Message]] = msgspec.field(default_factory=dict)


class NetworkChanges(msgspec.Struct, frozen=True):
    """The functions to call with what changes."""

    channel_added: channels.Changed
    channel_removed: channels.Changed
    service_added: services.Changed
    service_removed: services.Changed
    parameters_changed: ParametersChanged
    report_module: Report


class FoxgloveNetwork:
    """What all clients share, as of the last `review`. Raises Closed if the module is not open."""

    def __init__(
        self, module: Module, options: FoxgloveOptions, changes: NetworkChanges, refused: Counter[str]
    ) -> None:
        self.options = options
        self.refused = refused
        """What clients asked for in vain, by reason."""
        self._network = module.network
        self._node = node = Node(_NODE, module.space)
        self._types = types = TypeFinder(module, options.types)
        self._views: dict[str, TopicView] = {}
        self.channels = ChannelTable(module.space, node, types, changes.channel_added, changes.channel_removed)
        self.services = ServiceTable(node, types, changes.service_added, changes.service_removed)
        self.publications = ClientPublications(node, types)
        self.parameters = NetworkParameters(module, changes.parameters_changed, changes.report_module)

    def review(self) -> None:
        """Update channels and services by what is on the network now."""
        self._views = self._network.topics()
        self.channels.review(self._views)
        if self.options.allow_publish:
            self.services.review(self._views)

    def graph(self) -> ConnectionGraph:
        """Return which node publishes, subscribes and serves what."""
        return connections(self._views)

    def close(self) -> None:
        """End all subscriptions, publications and calls."""
        self.parameters.unfollow()
        self.services.close()
        self.channels.close()
        self._types.close()
        self._node.close()
