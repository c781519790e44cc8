"""The protocol between a page of `r2p dash` and its process, over one WebSocket at `/dash`.

    page to process   a JSON object each: a request, with `op` and a number `id`
    process to page   a JSON object each: the answer, {"id": 3, "result": ...} or {"id": 3, "error": "why"}; or news,
                      which have `op` and no `id`
    process to page   bytes: the points of plots

News:

    hello       first of all: what the page may do, and whether it shows a network or a recording
    state       the figures that have changed since the last one: {"op": "state", "time": ns, "changed": {"topics":
                {NAME: figures}, ...}, "gone": {"topics": [NAME, ...], ...}}; first all of them. Tables: modules,
                topics, services, links ("MODULE LINK"), buses
    log         {"op": "log", "records": [{"time": ns, "level": 20, "module": ..., "node": ..., "text": ...}, ...],
                "dropped": n}: levels as in Python's logging; `dropped` records of before these were lost, in all
    message     the newest message of a watched topic, ten times a second at most: {"op": "message", "topic": ...,
                "time": ns, "module": ..., "node": ..., "sequence": n, "skipped": n, "fields": {...}}
    published   of a topic that is published at a rate, once a second, and at its end: {"op": "published", "topic": ...,
                "sent": n, "running": bool, "error"?: why it has ended}
    dropped     {"op": "dropped", "streams": {NAME: n}}: what this page was too slow for, in all: points of "plot
                STREAM", messages of "message TOPIC", records of "log"
    clock       of a recording: {"op": "clock", "time": ns, "playing": true, "rate": 1.0}
    plotted     of a recording, after points: {"op": "plotted", "stream": n, "share": how much of it is read, 0 to 1,
                "messages": n, "undecodable": n}
    timeline    of a recording that is read through: {"op": "timeline", "share": 0 to 1, "events": [{"time", "kind",
                "about", "text", "count", "late", "until"}, ...], "misses": [[TOPIC, KIND, step, count], ...], "gaps":
                [[TOPIC, start, end], ...], "left_out": n, "damaged": n}: what was found since the last one

Of a recording, points replace all earlier ones of their stream: the first ones are coarse. Its `hello` has `recording`
true. With {"cleared": true}, the records of a `log` replace all before them, as its time has changed.

Points, little-endian: u8 1, u8 number of columns, u16 stream, u32 number of points, f64 times (s, UTC), then f64 values
of the first column, of the second one, ... NaN: the message had no value there.
"""

import struct
from collections.abc import Sequence
from typing import Any, Literal

import msgspec

POINTS = 1
STREAM_MAX = (1 << 16) - 1
"""The greatest number of a stream."""

_HEAD = struct.Struct("<BBHI")


class _PageRequest(msgspec.Struct, tag_field="op", forbid_unknown_fields=True, kw_only=True):
    id: int


class Plot(_PageRequest, tag="plot"):
    """Send points of fields ("odometry.pose.x", "scan.ranges[3]"), all of one topic, as `stream`.

    A recording answers with at most `points` for each column between `start` and `end` (s, UTC); the smallest and the
    largest value of each step are among them.
    """

    stream: int
    fields: list[str]
    start: float | None = None
    end: float | None = None
    points: int = 2000


class StopPlot(_PageRequest, tag="stop_plot"):
    """Stop sending points of a stream."""

    stream: int


class Watch(_PageRequest, tag="watch"):
    """Send the newest messages of a topic, decoded; meanwhile its figures have its latency and its losses, too."""

    topic: str


class Unwatch(_PageRequest, tag="unwatch"):
    """Stop sending messages of a topic."""

    topic: str


class FollowLog(_PageRequest, tag="log"):
    """Send log records, from now on and the last ones before; `level` DEBUG, INFO, WARNING, ERROR, FATAL and above."""

    level: str = "INFO"


class Describe(_PageRequest, tag="describe"):
    """Answer with a type: {"type": ..., "fields": [{"path", "kind", ...}, ...], "zero": {...}}.

    Of a topic, or of the standard `type` that it is to have; or of a service's request and response: {"request": {...},
    "response": {...}}. Without any of these the answer has the names of the standard types: {"types": [...]}.

    Fields are in their order, and flat: "pose", "pose.x". Parts of each element of an array have [] in their path:
    "points[].x". `kind` is a number's ("u8" to "u64", "i8" to "i64", "f32", "f64"), "bool", "text", or "message", whose
    parts follow. Of arrays it is that of the elements, and there is a `length`; or a `max`, if it varies. A text has a
    `limit` of bytes. Where there are names for its values a field has an `enum`: {"AUTO": 1, ...}. `plottable` is set
    for what `Plot` takes. `zero` is the message with all fields zero, as `Publish` takes it.
    """

    topic: str = ""
    service: str = ""
    type: str = ""


class Publish(_PageRequest, tag="publish"):
    """Publish a message, once, or `rate` times a second until another one comes, it is stopped, or the page leaves.

    The answer is {"subscribers": n}, to whom the first one went. `type` is for a topic new to the network: the full
    name of one of r2p's standard types.
    """

    topic: str
    value: dict[str, Any]
    type: str = ""
    rate: float = 0.0


class StopPublishing(_PageRequest, tag="stop_publishing"):
    """Publish a topic no more at a rate."""

    topic: str


class CallService(_PageRequest, tag="call"):
    """Call a service, and answer with its response."""

    service: str
    value: dict[str, Any]
    timeout: float = 5.0


class ListParameters(_PageRequest, tag="parameters"):
    """Answer with the parameters of a module, as a list of `ParameterInfo`."""

    module: str


class SetParameters(_PageRequest, tag="set_parameters"):
    """Set parameters of a node, all or nothing; None is the value of the start."""

    module: str
    node: str
    values: dict[str, Any]


class SaveParameters(_PageRequest, tag="save_parameters"):
    """Have a module save what was set."""

    module: str


class OrderNode(_PageRequest, tag="node"):
    """Start, stop or restart a node."""

    module: str
    node: str
    order: Literal["start", "stop", "restart"]


class OrderModule(_PageRequest, tag="module"):
    """Stop, start or reboot a module."""

    module: str
    order: Literal["stop", "start", "reboot"]


class Seek(_PageRequest, tag="seek"):
    """Show a recording as it was at a time (ns, UTC)."""

    time: int


class Play(_PageRequest, tag="play"):
    """Let the time of a recording run, at a rate; 0 stops it."""

    rate: float = 1.0


class ReadTimeline(_PageRequest, tag="timeline"):
    """Answer with what is in a recording, and send what happened as news, while it is found.

    {"start": ns, "end": ns, "step": ns of a step of misses, "files": [...], "problems": [...]}
    """


DashRequest = (
    Plot
    | StopPlot
    | Watch
    | Unwatch
    | FollowLog
    | Describe
    | Publish
    | StopPublishing
    | CallService
    | ListParameters
    | SetParameters
    | SaveParameters
    | OrderNode
    | OrderModule
    | Seek
    | Play
    | ReadTimeline
)

_decoder = msgspec.json.Decoder(DashRequest)
encode = msgspec.json.Encoder().encode
"""Encodes messages to the page: figures, `ParameterInfo` and plain values."""


def decode(data: str | bytes) -> DashRequest:
    """Decode a request. Raises msgspec.ValidationError or msgspec.DecodeError, in words for the author of a page."""
    try:
        request: DashRequest = _decoder.decode(data)
    except RecursionError as error:
        raise msgspec.DecodeError(str(error)) from None
    return request


def points(stream: int, times: Sequence[float], columns: Sequence[Sequence[float]]) -> bytes:
    """Encode points: `times` in s, and the values of each column at these."""
    return join_points(stream, len(times), pack_values(times), [pack_values(column) for column in columns])


def pack_values(values: Sequence[float]) -> bytes:
    """Pack times, or the values of a column."""
    return struct.pack(f"<{len(values)}d", *values)


def join_points(stream: int, count: int, times: bytes, columns: Sequence[bytes]) -> bytes:
    """Encode points whose times and columns are packed already, perhaps for several pages."""
    return b"".join((_HEAD.pack(POINTS, len(columns), stream, count), times, *columns))
