"""XMLRPC over HTTP/1.1, as ROS 1's master and nodes speak it (skeleton: signatures are final)."""

from collections import Counter
from collections.abc import Callable

from r2p.errors import Error

Value = None | bool | int | float | str | bytes | list["Value"] | dict[str, "Value"]
"""What XMLRPC carries."""


class XmlRpcError(Error):
    """A call that the other end answered with a fault, or with what is not XMLRPC; `uri` and method are in the text."""


class XmlRpcClient:
    """Calls methods of several servers, with one connection for each that is kept."""

    async def call(self, uri: str, method: str, *arguments: object, timeout: float = 5.0) -> Value:
        """Call a method and return its value.

        Raises XmlRpcError for a fault or an unusable answer, OSError if the connection fails, TimeoutError.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Close all connections; calls that wait end with OSError."""


Handler = Callable[[str, list[Value], str], Value]
"""Answers a call, from its method, its arguments, and the address of the caller. Raises XmlRpcError for a fault."""


class XmlRpcServer:
    """Answers calls at a port of its own."""

    port: int

    def __init__(self, host: str, handler: Handler, lost: Counter[str]) -> None:
        """Bind a free port of `host`. Raises OSError."""

    async def start(self) -> None:
        """Accept connections."""

    async def close(self) -> None:
        """Stop, and close all connections."""
