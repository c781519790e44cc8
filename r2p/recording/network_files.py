"""Files that are attached to a recording: the network as it was, and the values of all parameters."""

import json
import platform
from collections.abc import Iterable
from typing import Any

import msgspec
import tomli_w

from r2p.modules.graph import NetworkView
from r2p.parameters.definition import ParameterInfo
from r2p.version import __version__

NETWORK, PARAMETERS_FILE = "network.json", "parameters.toml"
"""The names of the attachments."""


def network_file(network: NetworkView) -> bytes:
    """Return the modules, nodes and topics of a network, and the versions of what records it."""
    modules = [msgspec.to_builtins(view) for view in network.modules()]
    nodes = [
        {"module": module, "node": node, "publishes": published, "subscribes": subscribed}
        for (module, node), (published, subscribed) in network.nodes().items()
    ]
    topics = [
        {"topic": view.name, "type": view.layout.name if view.layout else view.ros_type, "size": view.size}
        for view in network.topics().values()
    ]
    versions = {"r2p": __version__, "python": platform.python_version(), "system": platform.system()}
    content = {"versions": versions, "modules": modules, "nodes": nodes, "topics": topics}
    return json.dumps(content, indent=2).encode()


def parameters_file(infos: Iterable[ParameterInfo]) -> bytes:
    """Return parameters as a file that `r2p run --params` and `r2p param load` read.

    Modules have the names that they have themselves, without the prefix of a gateway, unless two would be the same.
    """
    infos = list(infos)
    modules = {info.module for info in infos}
    short = {name: name.rpartition("/")[2] for name in modules}
    taken = list(short.values())
    tables: dict[str, Any] = {}
    for info in infos:
        own = short[info.module]
        name = own if taken.count(own) == 1 else info.module
        value = list(info.value) if isinstance(info.value, tuple) else info.value
        tables.setdefault(name, {}).setdefault(info.node, {})[info.name] = value
    return tomli_w.dumps({"format": 1, "params": tables}).encode()
