"""The calls of a ROS 1 master (skeleton: signatures are final)."""

from r2p.errors import Error
from r2p.ros.ros1.xmlrpc import Value, XmlRpcClient


class MasterError(Error):
    """A call that the master refused (code -1 or 0), with its text."""


class MasterClient:
    """Calls one master. Besides MasterError every call raises what `XmlRpcClient.call` does."""

    def __init__(self, client: XmlRpcClient, uri: str, timeout: float = 3.0) -> None:
        self.uri = uri

    async def register_publisher(self, node: str, topic: str, type: str, api: str) -> list[str]:
        raise NotImplementedError

    async def unregister_publisher(self, node: str, topic: str, api: str) -> int:
        raise NotImplementedError

    async def register_subscriber(self, node: str, topic: str, type: str, api: str) -> list[str]:
        raise NotImplementedError

    async def unregister_subscriber(self, node: str, topic: str, api: str) -> int:
        raise NotImplementedError

    async def register_service(self, node: str, service: str, service_api: str, api: str) -> None:
        raise NotImplementedError

    async def unregister_service(self, node: str, service: str, service_api: str) -> int:
        raise NotImplementedError

    async def lookup_service(self, node: str, service: str) -> str:
        raise NotImplementedError

    async def get_param(self, node: str, key: str) -> Value:
        raise NotImplementedError
