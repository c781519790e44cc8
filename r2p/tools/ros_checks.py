"""What `r2p doctor` checks of a link to a ROS network: what ROS programs never say, and users search for longest.

For ROS 1 these are the master, the address by which other nodes reach this computer, and whether this computer reaches
each of them: a node that is registered under an address which none of them reaches is in all lists, and no data come.
"""

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from r2p.errors import Error, TransportError
from r2p.tools.checks import Check
from r2p.tools.session import Session

if TYPE_CHECKING:
    from r2p.ros.ros1.master import MasterClient
    from r2p.ros.ros1.xmlrpc import XmlRpcClient

_NAME = "/r2p_doctor"
_ANSWER = 3.0  # seconds for the answer of a node
_LOOPBACK = ("127.", "localhost", "::1")


async def before(url: str) -> AsyncIterator[Check]:
    """Yield the checks that need no link; without a master, it is pointless to try one."""
    if url.partition(":")[0] == "ros1":
        async for check in _ros1(url):
            yield check


def nodes(session: Session) -> Iterator[Check]:
    """Yield a check for each ROS node that the link has found; those of ROS 1 are in `before`."""
    if session.settings.via[0].startswith("ros1:"):
        return
    found = sorted(view.name for view in session.module.network.modules() if view.link)
    for node in found:
        yield Check("node", True, node)
    if not found:
        do = "ROS_DOMAIN_ID and RMW_IMPLEMENTATION as the other nodes have them\nros2 node list"
        yield Check("nodes", False, "no ROS node is there yet, but this one", do)


# ROS 1


async def _ros1(url: str) -> AsyncIterator[Check]:
    from r2p.ros.ros1.environment import find_address, reachable_host
    from r2p.ros.ros1.master import MasterClient
    from r2p.ros.ros1.xmlrpc import XmlRpcClient

    try:
        address = find_address(url.partition(":")[2].partition(",")[0].partition("?")[0], os.environ, {})
    except TransportError as error:
        yield Check("master", False, str(error), "export ROS_MASTER_URI=http://robot:11311")
        return
    client = XmlRpcClient()
    master = MasterClient(client, address.master)
    try:
        try:
            await master.call("getPid", _NAME)
        except (Error, OSError) as error:
            yield Check("master", False, f"{address.master}: {_reason(error)}", _NO_MASTER)
            return
        yield Check("master", True, f"{address.master} answers")
        yield own_address(address.host or reachable_host(_local(address.master)), address.master)
        async for check in _other_nodes(master, client):
            yield check
    finally:
        client.close()


_NO_MASTER = "start one there: roscore\nor name its computer: export ROS_MASTER_URI=http://robot:11311"


def _local(master: str) -> str:
    """Return the address that this computer has towards the master."""
    parts = urlsplit(master)
    try:
        family, kind, _, _, where = socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as udp:
            udp.connect(where)  # which finds the way, and sends nothing
            return str(udp.getsockname()[0])
    except OSError:
        return ""


def own_address(host: str, master: str) -> Check:
    """Check the address that other nodes get for this computer."""
    found = f"other nodes reach this computer as {host}"
    if host.startswith(_LOOPBACK) and not (urlsplit(master).hostname or "").startswith(_LOOPBACK):
        do = f"export ROS_IP={_local(master)}"
        return Check("address", False, f"{found}, which is each of them itself", do)
    try:
        socket.getaddrinfo(host, None)
    except OSError:
        do = f"export ROS_IP={_local(master)}\nROS_HOSTNAME is for names that all computers know"
        return Check("address", False, f"{found}, a name that is not even known here", do)
    return Check("address", True, found)


async def _other_nodes(master: "MasterClient", client: "XmlRpcClient") -> AsyncIterator[Check]:
    """Check whether this computer reaches each registered node."""
    state = await master.get_system_state(_NAME)
    tables = (state.publishers, state.subscribers, state.services)
    names = sorted({node for table in tables for having in table.values() for node in having})
    for check in await asyncio.gather(*(_other_node(name, master, client) for name in names)):
        yield check
    if not names:
        yield Check("nodes", True, "none is registered yet")


async def _other_node(name: str, master: "MasterClient", client: "XmlRpcClient") -> Check:
    uri = "an address that the master does not give"
    try:
        uri = await master.lookup_node(_NAME, name)
        await client.call(uri, "getPid", _NAME, timeout=_ANSWER)
    except socket.gaierror:
        host = urlsplit(uri).hostname
        do = f"where {name} starts: export ROS_IP=ITS_ADDRESS\necho 'ITS_ADDRESS {host}' | sudo tee -a /etc/hosts"
        return Check("node", False, f"{name} is at {uri}, but {host} is not known here", do)
    except (Error, OSError) as error:
        do = "rosnode cleanup removes a node that has ended\nelse look for a firewall, or ROS_IP where it starts"
        return Check("node", False, f"{name} at {uri}: {_reason(error)}", do)
    return Check("node", True, f"{name} answers at {uri}")


def _reason(error: Exception) -> str:
    match error:
        case socket.gaierror():
            return "no computer of this name is known here"
        case ConnectionRefusedError():
            return "nothing listens there"
        case TimeoutError():
            return f"no answer within {_ANSWER:g} s"
    return str(error)
