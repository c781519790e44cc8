"""What the own services of nodes carry (PROTOCOL.md 9): lists of nodes, commands for them, pieces of code, log levels.

Each is a version and the bytes of one r2p message. Later versions may append to it: what follows is ignored.
"""

import enum
import struct
from typing import Annotated, TypeVar

from r2p.codecs.own_services import PAGE_MAX
from r2p.errors import DecodeError, Error
from r2p.messages import Len, Max, Message, f32, f64, i32, layout, u8, u32

M = TypeVar("M", bound=Message)

VERSION = 1

DIGEST = 16
"""Bytes of the SHA-256 of compressed code by which its pieces belong together."""

COMPRESSED_MAX = 64 << 10
"""Bytes of compressed code."""

PIECE_MAX = 144
"""Bytes of one piece of it: a message of own services has room for them."""

NO_DIGEST = (0,) * DIGEST
"""Stands for code in a file of the module's computer."""

_HEAD = struct.Struct("<BH")
_CONTENT_HEAD = struct.Struct("<BI")
_TEXT_MAX = 8000
_MANY = 4096

_Name = Annotated[str, Max(64)]
_Digest = Annotated[tuple[u8, ...], Len(DIGEST)]


class NodeAction(enum.IntEnum):
    """What a command does to a node."""

    START = 1
    STOP = 2
    RESTART = 3
    SWAP = 4


class NodeCommand(Message, name="r2p_msgs/NodeCommand"):
    """A command for `node`; `name` is that of a new one, empty for the function's, or in a swap the old node's.

    The `function` is in `file` on the module's computer, or, with a digest that is not 0, in code that was sent as such
    a file. `restart` and `priority` are those of a node that is started; `partial` as in SwapLimits.
    """

    action: u8 = 0
    node: _Name = ""
    name: _Name = ""
    file: Annotated[str, Max(160)] = ""
    function: _Name = ""
    digest: _Digest = NO_DIGEST
    restart: bool = False
    partial: bool = False
    priority: i32 = 0


class TopicPauseEntry(Message, name="r2p_msgs/TopicPause"):
    """A TopicPause; `pause` and `period` are in seconds, NaN: unknown, or none."""

    topic: Annotated[str, Max(255)] = ""
    publisher_class: u8 = 0
    pause: f64 = 0.0
    period: f64 = 0.0


class NodeOutcome(Message, name="r2p_msgs/NodeOutcome"):
    """What a command has done: the name of the node, and the pauses of a swap; or an error."""

    error: Annotated[str, Max(_TEXT_MAX)] = ""
    node: _Name = ""
    cleaned_up: bool = True
    topics: Annotated[tuple[TopicPauseEntry, ...], Max(_MANY)] = ()


class CodePiece(Message, name="r2p_msgs/CodePiece"):
    """A piece of code of `total` bytes: `data` are those from `offset` on."""

    digest: _Digest = NO_DIGEST
    total: u32 = 0
    offset: u32 = 0
    data: Annotated[tuple[u8, ...], Max(PIECE_MAX)] = ()


class CodeReceived(Message, name="r2p_msgs/CodeReceived"):
    """How many bytes of the code have arrived in a row."""

    received: u32 = 0


class LogLevelCommand(Message, name="r2p_msgs/LogLevelCommand"):
    """The level from which on a node logs, as in `logging`; 0: that of its start. Without a node, of all nodes."""

    node: _Name = ""
    level: u8 = 0


class NodeNames(Message, name="r2p_msgs/NodeNames"):
    """The nodes that a command concerned."""

    nodes: Annotated[tuple[_Name, ...], Max(_MANY)] = ()


class NodeInfo(Message, name="r2p_msgs/NodeInfo"):
    """A node of a module, also one that has ended.

    `age` is in seconds, since its last start or restart; NaN if it does not run. `restarts` counts those after crashes.
    `source` is its function. `log_level` was set at run time, 0: was not. `error`: what ended it.
    """

    node: _Name = ""
    running: bool = False
    age: f64 = 0.0
    restarts: u32 = 0
    priority: i32 = 0
    source: Annotated[str, Max(200)] = ""
    log_level: u8 = 0
    error: Annotated[str, Max(300)] = ""


class NodeList(Message, name="r2p_msgs/NodeList"):
    """The nodes of a module. `cpu` is the share of one processor that its process has used, all modules in it together,
    in the last `cpu_over` seconds.
    """

    cpu: f32 = 0.0
    cpu_over: f32 = 0.0
    allow_load: bool = False
    nodes: Annotated[tuple[NodeInfo, ...], Max(_MANY)] = ()


def encode_argument(message: Message) -> bytes:
    """Encode the argument of a request. Raises Error if it does not fit."""
    part = message.encode()
    data = _HEAD.pack(VERSION, len(part)) + part
    if len(data) > PAGE_MAX:
        raise Error(f"file, function and names are {len(data) - PAGE_MAX} bytes too long together: use shorter ones")
    return data


def decode_argument(kind: type[M], data: bytes) -> M:
    """Decode the argument of a request. Raises DecodeError."""
    return _decode(kind, data, _HEAD)


def encode_content(message: Message) -> bytes:
    """Encode the content of an answer."""
    part = message.encode()
    return _CONTENT_HEAD.pack(VERSION, len(part)) + part


def decode_content(kind: type[M], data: bytes) -> M:
    """Decode the content of an answer. Raises DecodeError."""
    return _decode(kind, data, _CONTENT_HEAD)


def _decode(kind: type[M], data: bytes, head: struct.Struct) -> M:
    if len(data) < head.size:
        raise DecodeError(f"{len(data)} bytes, at least {head.size} are needed")
    version, size = head.unpack_from(data)
    if version < VERSION or len(data) < head.size + size:
        raise DecodeError(f"version {version} with {size} of {len(data) - head.size} bytes")
    return layout(kind).decode(data[head.size : head.size + size])
