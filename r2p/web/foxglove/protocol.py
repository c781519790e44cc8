"""The messages of the Foxglove WebSocket protocol, in its versions `foxglove.sdk.v1` and `foxglove.websocket.v1`.

Most are JSON objects with an `op`; what comes often is binary, little-endian:

| from | opcode | content |
| --- | --- | --- |
| server | 1 message | `u32 subscription, u64 time` (ns), the message |
| | 2 time | `u64 time` (ns) |
| | 3 response of a service | `u32 service, u32 call, u32 size, encoding` (of `size` bytes), the response |
| | 4 asset | `u32 request, u8 status` (0 the file, 1 an error)`, u32 size, error` (of `size` bytes), the file |
| client | 1 message | `u32 channel` (of the client), the message |
| | 2 request to a service | as 3, the request |

Both versions have the same messages. Identifiers of subscriptions, calls and a client's channels are the client's.
"""

import enum
import struct
from collections.abc import Iterable
from typing import Annotated, Any, TypeAlias

import msgspec

from r2p.errors import DecodeError

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

CDR, JSON = "cdr", "json"
"""Encodings of messages."""

TEXT_MAX = 1000
"""Characters of a text of an error, whose parts may come from a client."""

Number = Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]

_CUT = "..."


class StatusLevel(enum.IntEnum):
    """The severity of a status."""

    INFO = 0
    WARNING = 1
    ERROR = 2


class _ServerOpcode(enum.IntEnum):
    MESSAGE = 1
    TIME = 2
    RESPONSE = 3
    ASSET = 4


class _ClientOpcode(enum.IntEnum):
    MESSAGE = 1
    REQUEST = 2


# From a client


class _FoxgloveFields(msgspec.Struct, rename="camel", frozen=True):
    pass


class _FoxgloveOperation(msgspec.Struct, rename="camel", tag_field="op", frozen=True):
    pass


class ChannelSubscription(_FoxgloveFields, frozen=True):
    """The client's number of a subscription, and the channel."""

    id: Number
    channel_id: Number


class ClientChannel(_FoxgloveFields, frozen=True):
    """A channel that a client publishes."""

    id: Number
    topic: str
    encoding: str
    schema_name: str = ""
    schema_encoding: str | None = None
    schema: str | None = None


class FoxgloveParameter(_FoxgloveFields, frozen=True, omit_defaults=True):
    """A parameter. `value` None or absent: it has none; `type` is "float64", "float64_array", "byte_array" or None."""

    name: str
    value: Any = None
    type: str | None = None


class SubscribeChannels(_FoxgloveOperation, tag="subscribe", frozen=True):
    """Send the messages of channels."""

    subscriptions: list[ChannelSubscription]


class UnsubscribeChannels(_FoxgloveOperation, tag="unsubscribe", frozen=True):
    """Stop sending the messages of these subscriptions."""

    subscription_ids: list[Number]


class AdvertiseChannels(_FoxgloveOperation, tag="advertise", frozen=True):
    """The client is going to publish on channels."""

    channels: list[ClientChannel]


class UnadvertiseChannels(_FoxgloveOperation, tag="unadvertise", frozen=True):
    """The client publishes on these no more."""

    channel_ids: list[Number]


class GetParameterValues(_FoxgloveOperation, tag="getParameters", frozen=True):
    """Send the values of parameters; of all, if none is named."""

    parameter_names: list[str]
    id: str | None = None


class SetParameterValues(_FoxgloveOperation, tag="setParameters", frozen=True):
    """Set parameters, and send their values if there is an `id`."""

    parameters: list[FoxgloveParameter]
    id: str | None = None


class SubscribeParameters(_FoxgloveOperation, tag="subscribeParameterUpdates", frozen=True):
    """Send the values of parameters whenever they change; of all, if none is named."""

    parameter_names: list[str]


class UnsubscribeParameters(_FoxgloveOperation, tag="unsubscribeParameterUpdates", frozen=True):
    """Stop sending updates of these parameters; an empty list names all."""

    parameter_names: list[str]


class SubscribeGraph(_FoxgloveOperation, tag="subscribeConnectionGraph", frozen=True):
    """Send which nodes publish, subscribe and serve what."""


class UnsubscribeGraph(_FoxgloveOperation, tag="unsubscribeConnectionGraph", frozen=True):
    """Send it no more."""


class FetchAsset(_FoxgloveOperation, tag="fetchAsset", frozen=True):
    """Send a file, such as the description of a robot."""

    uri: str
    request_id: Number


class PublishedData(msgspec.Struct, frozen=True):
    """A message that a client publishes."""

    channel: int
    data: bytes


class ServiceCall(msgspec.Struct, frozen=True):
    """A request to a service, or its response."""

    service: int
    call: int
    encoding: str
    data: bytes


ClientOperation: TypeAlias = (
    SubscribeChannels
    | UnsubscribeChannels
    | AdvertiseChannels
    | UnadvertiseChannels
    | GetParameterValues
    | SetParameterValues
    | SubscribeParameters
    | UnsubscribeParameters
    | SubscribeGraph
    | UnsubscribeGraph
    | FetchAsset
)
ClientMessage: TypeAlias = ClientOperation | PublishedData | ServiceCall

_CHANNEL = struct.Struct("<BI")
_CALL = struct.Struct("<BIII")
_MESSAGE = struct.Struct("<BIQ")
_TIME = struct.Struct("<BQ")
_ASSET = struct.Struct("<BIBI")
_ASSET_ERROR = 1

_decoder = msgspec.json.Decoder(ClientOperation)
_encode = msgspec.json.Encoder().encode


def decode(message: str | bytes) -> ClientMessage:
    """Decode a message of a client. Raises DecodeError, which says what is wrong with it."""
    if not isinstance(message, str):
        return _decode_binary(message)
    try:
        operation: ClientOperation = _decoder.decode(message)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:  # ValidationError is a DecodeError
        raise DecodeError(f"invalid message: {cut(str(error))}") from None
    return operation


def _decode_binary(data: bytes) -> ClientMessage:
    opcode = data[0] if data else 0
    try:
        if opcode == _ClientOpcode.MESSAGE:
            _, channel = _CHANNEL.unpack_from(data)
            return PublishedData(channel, data[_CHANNEL.size :])
        if opcode == _ClientOpcode.REQUEST:
            return _decode_call(data)
    except (struct.error, UnicodeError) as error:
        raise DecodeError(f"invalid binary message of {len(data)} bytes: {error}") from None
    raise DecodeError(f"invalid message: unknown binary opcode {opcode}" if data else "invalid message: it is empty")


def _decode_call(data: bytes) -> ServiceCall:
    _, service, call, size = _CALL.unpack_from(data)
    begin = _CALL.size
    if size > len(data) - begin:
        raise DecodeError(f"invalid request: an encoding of {size} bytes with {len(data) - begin} bytes behind it")
    return ServiceCall(service, call, data[begin : begin + size].decode(), data[begin + size :])


# From the server


class ServerChannel(_FoxgloveFields, frozen=True):
    """A channel of the server, whose schema is a text."""

    id: int
    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: str


class PartInfo(_FoxgloveFields, frozen=True):
    """The request or the response of a service."""

    encoding: str
    schema_name: str
    schema_encoding: str
    schema: str


class ServiceInfo(_FoxgloveFields, frozen=True):
    """A service of the server."""

    id: int
    name: str
    type: str
    request: PartInfo
    response: PartInfo


class GraphUpdate(_FoxgloveFields, frozen=True, kw_only=True):
    """What has changed: by topic the nodes that publish and subscribe, by service those that serve it."""

    published: dict[str, list[str]]
    subscribed: dict[str, list[str]]
    served: dict[str, list[str]]
    removed_topics: list[str]
    removed_services: list[str]


def _json(op: str, **values: object) -> str:
    return _encode({"op": op, **values}).decode()


def server_info(
    name: str, capabilities: Iterable[str], encodings: Iterable[str], metadata: dict[str, str], session: str
) -> str:
    """Encode the first message of a server. `session` is the same as long as its channels keep their numbers."""
    return _json(
        "serverInfo",
        name=name,
        capabilities=list(capabilities),
        supportedEncodings=list(encodings),
        metadata=metadata,
        sessionId=session,
    )


def status(level: StatusLevel, message: str, id: str | None = None) -> str:
    """Encode a text for the user, which stays until another one has its `id`, or it is removed."""
    return _json("status", level=int(level), message=message, **({} if id is None else {"id": id}))


def remove_status(ids: Iterable[str]) -> str:
    """Return the JSON that removes the status messages with these ids."""
    return _json("removeStatus", statusIds=list(ids))


def advertise(channels: Iterable[ServerChannel]) -> str:
    """Encode channels that are new."""
    return _json("advertise", channels=list(channels))


def unadvertise(channels: Iterable[int]) -> str:
    """Encode that channels are gone."""
    return _json("unadvertise", channelIds=list(channels))


def advertise_services(services: Iterable[ServiceInfo]) -> str:
    """Encode services that are new."""
    return _json("advertiseServices", services=list(services))


def unadvertise_services(services: Iterable[int]) -> str:
    """Encode that services are gone."""
    return _json("unadvertiseServices", serviceIds=list(services))


def parameter_values(parameters: Iterable[FoxgloveParameter], id: str | None = None) -> str:
    """Encode parameters: the answer to the request with this `id`, or what has changed."""
    return _json("parameterValues", parameters=list(parameters), **({} if id is None else {"id": id}))


def connection_graph(update: GraphUpdate) -> str:
    """Encode what has changed in the graph of connections."""
    return _json(
        "connectionGraphUpdate",
        publishedTopics=[{"name": name, "publisherIds": ids} for name, ids in update.published.items()],
        subscribedTopics=[{"name": name, "subscriberIds": ids} for name, ids in update.subscribed.items()],
        advertisedServices=[{"name": name, "providerIds": ids} for name, ids in update.served.items()],
        removedTopics=update.removed_topics,
        removedServices=update.removed_services,
    )


def call_failure(service: int, call: int, message: str) -> str:
    """Encode that a call has no response, and why."""
    return _json("serviceCallFailure", serviceId=service, callId=call, message=message)


def message(subscription: int, time: int, data: bytes) -> bytes:
    """Encode a message of a channel, received at `time` (UTC, ns)."""
    return _MESSAGE.pack(_ServerOpcode.MESSAGE, subscription, time) + data


def time(now: int) -> bytes:
    """Encode the time of a server whose clock is not that of the client (ns)."""
    return _TIME.pack(_ServerOpcode.TIME, now)


def response(service: int, call: int, encoding: str, data: bytes) -> bytes:
    """Encode the response of a service."""
    name = encoding.encode()
    return _CALL.pack(_ServerOpcode.RESPONSE, service, call, len(name)) + name + data


def asset_error(request: int, text: str) -> bytes:
    """Encode that a file can't be sent, and why."""
    data = text.encode()
    return _ASSET.pack(_ServerOpcode.ASSET, request, _ASSET_ERROR, len(data)) + data


def cut(text: str) -> str:
    """Return a text for people, of at most TEXT_MAX characters."""
    return text if len(text) <= TEXT_MAX else text[: TEXT_MAX - len(_CUT)] + _CUT
