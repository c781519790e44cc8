"""The calls of a ROS 1 master: registrations, names, and the parameter server.

Each call has the name of the calling node as its first argument, and answers `[code, text, value]` with code 1 for
success, 0 for a failure, and -1 for an error of the caller.
"""

from collections.abc import Sequence
from typing import Final

import msgspec

from r2p.errors import Error
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError
from r2p.ros.ros1.xmlrpc_codec import Value

TIMEOUT_S: Final = 3.0
"""Seconds for the answer of a master, which is there in milliseconds."""


class MasterError(Error):
    """A call that the master refused, with its text."""


class SystemState(msgspec.Struct, frozen=True):
    """All registrations: names of topics and services, each with the names of its nodes."""

    publishers: dict[str, list[str]]
    subscribers: dict[str, list[str]]
    services: dict[str, list[str]]


class MasterClient:
    """Calls one master. Besides MasterError every call raises what `XmlRpcClient.call` does."""

    def __init__(self, client: XmlRpcClient, uri: str, timeout: float = TIMEOUT_S) -> None:
        self.uri = uri
        self._client = client
        self._timeout = timeout

    async def call(self, method: str, node: str, *arguments: object) -> Value:
        """Call a method as a node, and return the value in the answer."""
        uri, timeout = self.uri, self._timeout
        return value_of(method, await self._client.call(uri, method, node, *arguments, timeout=timeout, keep=True))

    # Registrations

    async def register_publisher(self, node: str, topic: str, type: str, api: str) -> list[str]:
        """Register a publisher; return the slave URIs of the topic's subscribers."""
        return _texts(await self.call("registerPublisher", node, topic, type, api))

    async def unregister_publisher(self, node: str, topic: str, api: str) -> int:
        """Unregister a publisher; return how many there were: 0 or 1."""
        return _number(await self.call("unregisterPublisher", node, topic, api))

    async def register_subscriber(self, node: str, topic: str, type: str, api: str) -> list[str]:
        """Register a subscriber (type `*`: any); return the slave URIs of the topic's publishers."""
        return _texts(await self.call("registerSubscriber", node, topic, type, api))

    async def unregister_subscriber(self, node: str, topic: str, api: str) -> int:
        """Unregister a subscriber; return how many there were: 0 or 1."""
        return _number(await self.call("unregisterSubscriber", node, topic, api))

    async def register_service(self, node: str, service: str, service_api: str, api: str) -> None:
        """Register a service, in place of another node's: the last one counts."""
        await self.call("registerService", node, service, service_api, api)

    async def unregister_service(self, node: str, service: str, service_api: str) -> int:
        """Unregister a service; return how many there were: 0 or 1."""
        return _number(await self.call("unregisterService", node, service, service_api))

    # What there is

    async def lookup_node(self, node: str, name: str) -> str:
        """Return the slave URI of a node. Raises MasterError for an unknown node."""
        return str(await self.call("lookupNode", node, name))

    async def lookup_service(self, node: str, service: str) -> str:
        """Return the URI of a service, `rosrpc://host:port`. Raises MasterError for an unknown service."""
        return str(await self.call("lookupService", node, service))

    async def get_system_state(self, node: str) -> SystemState:
        """Return all registrations."""
        value = await self.call("getSystemState", node)
        tables = value if isinstance(value, list) else []
        publishers, subscribers, services = (_table(tables[i : i + 1]) for i in range(3))
        return SystemState(publishers, subscribers, services)

    async def get_topic_types(self, node: str) -> dict[str, str]:
        """Return the types of all topics that were ever registered; `*`: it had only subscribers of any type."""
        return _pairs(await self.call("getTopicTypes", node))

    async def get_pid(self, node: str) -> int:
        """Return the process of the master: another one has no registrations."""
        return _number(await self.call("getPid", node))

    # The parameter server

    async def get_param(self, node: str, key: str) -> Value:
        """Return a parameter, or a dict of those in a namespace. Raises MasterError if it is not set."""
        return await self.call("getParam", node, key)

    async def set_param(self, node: str, key: str, value: object) -> None:
        """Set a parameter; a dict replaces all of a namespace."""
        await self.call("setParam", node, key, value)

    async def delete_param(self, node: str, key: str) -> None:
        """Delete a parameter, or all in a namespace. Raises MasterError if it is not set."""
        await self.call("deleteParam", node, key)

    async def subscribe_param(self, node: str, api: str, key: str) -> Value:
        """Have changes of a parameter, or in a namespace, sent to a slave; return its value, `{}` if it is not set."""
        return await self.call("subscribeParam", node, api, key)

    async def unsubscribe_param(self, node: str, api: str, key: str) -> int:
        """End a subscription of a parameter."""
        return _number(await self.call("unsubscribeParam", node, api, key))


def value_of(method: str, answer: Value) -> Value:
    """Return the value in an answer of the master or a node. Raises MasterError, and XmlRpcError for other answers."""
    if not isinstance(answer, list) or len(answer) != 3 or not isinstance(answer[0], int):
        raise XmlRpcError(f"{method}: the answer is not code, text and value: {answer!r:.200}")
    code, text, value = answer
    if code != 1:
        raise MasterError(str(text))
    return value


def _texts(value: Value) -> list[str]:
    return [each for each in value if isinstance(each, str)] if isinstance(value, list) else []


def _number(value: Value) -> int:
    return value if isinstance(value, int) else 0


def _pairs(value: Value) -> dict[str, str]:
    rows = [_texts(row) for row in value] if isinstance(value, list) else []
    return {row[0]: row[1] for row in rows if len(row) == 2}


def _table(value: Sequence[Value]) -> dict[str, list[str]]:
    rows = value[0] if value and isinstance(value[0], list) else []
    found = [row for row in rows if isinstance(row, list) and len(row) == 2]
    return {row[0]: _texts(row[1]) for row in found if isinstance(row[0], str)}
