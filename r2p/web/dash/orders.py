"""Orders of pages to nodes and modules."""

from typing import Literal

from r2p.errors import WebError
from r2p.modules.module import Module
from r2p.monitoring.commands import find_module, send_command
from r2p.protocols.discovery.events import Command


async def order_node(module: Module, name: str, node: str, order: Literal["start", "stop", "restart"]) -> None:
    """Start, stop or restart a node of a module.

    Raises Error if the module refuses, or the node runs that is to start; and TimeoutError without an answer.
    """
    nodes = module.network.nodes_of(name)
    if order == "stop":
        await nodes.stop(node)
        return
    if order == "start":
        listed = await nodes.fetch()
        if any(each.node == node and each.running for each in listed.nodes):
            raise WebError(f"node {node} of {name} runs already")
    await nodes.restart(node)


async def order_module(module: Module, name: str, order: Literal["stop", "start", "reboot"]) -> None:
    """Stop a module's nodes, start those of a stopped module, or restart it.

    Raises Error if there is no such module or it does not obey, and TimeoutError if it does not confirm.
    """
    view = find_module(module, name)
    if order == "start" and view is not None and view.state == "running":
        raise WebError(f"module {name} runs already")
    await send_command(module, Command.STOP if order == "stop" else Command.REBOOT, name)
