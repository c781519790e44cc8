"""Messages that a recorder writes beside those of the topics."""

import math
from typing import Annotated

from r2p.messages import Max, Message, Timestamp, f64, i8, i64, u8, u32, u64
from r2p.recording.format import OWN_PREFIX

REST_MAX = 1 << 16
_NAME_MAX = 255

TEXT_MAX, VALUE_MAX = 1023, 1 << 16
"""Bytes of texts for people, and of the values of parameters."""

TOPICS_MAX = 4096
"""Topics of one message of the recorder's losses."""

EVENTS, SIGNALS, BUSES, SLOTS, PARAMETERS, LOGS = (
    f"{OWN_PREFIX}{name}" for name in ("events", "signals", "buses", "slots", "parameters", "log")
)
"""The channels of these messages."""
LOSSES = f"{OWN_PREFIX}recorder"
"""The channel of the recorder's own losses."""
BUS_LOADS, STATISTICS = f"{OWN_PREFIX}bus_load", f"{OWN_PREFIX}statistics"
"""What the channels of the loads of buses, and of the statistics of modules, begin with."""

_Name = Annotated[str, Max(_NAME_MAX)]
_Text = Annotated[str, Max(TEXT_MAX)]


class TopicLosses(Message, name="r2p_msgs/TopicLosses"):
    """Messages of a topic that are not in the recording, since it began.

    `dropped` ones arrived, and the disk was too slow or full; `missed` ones were lost before, on their way to the
    recorder, by the numbers of their publishers.
    """

    topic: _Name = ""
    dropped: u64 = 0
    missed: u64 = 0


class RecorderLosses(Message, name="r2p_msgs/RecorderLosses"):
    """What the recorder has lost since it began, once a second and at the end (channel `/r2p/recorder`).

    `messages` were received; of the topics only those are listed that have losses. `queued_bytes` wait for the disk.
    """

    messages: u64 = 0
    queued_bytes: u64 = 0
    topics: Annotated[tuple[TopicLosses, ...], Max(TOPICS_MAX)] = ()


class SampleMeta(Message, name="r2p_msgs/SampleMeta"):
    """What a message had besides its bytes. A message that has all of this as by default here has no companion.

    `deadline` and `expires` are instants (UTC, ns; 0: none) by the publisher's clock and by the recorder's; `expires` 0
    is the same as `deadline`. `clock_epoch`, `clock_offset` and `clock_error` (ns) are the translation of the stamp
    from the clock of that RTCAN network; without one, the error is -1. `number` is the publisher's, where it does not
    fit the 32 bits of the sequence (0: it does). `rest` is what CDR can't hold of the packed message.
    """

    stamped: bool = True
    drop_late: bool = True
    hops: u8 = 0
    deadline: i64 = 0
    expires: i64 = 0
    clock_epoch: i64 = 0
    clock_offset: i64 = 0
    clock_error: i64 = -1
    number: u64 = 0
    rest: Annotated[bytes, Max(REST_MAX)] = b""


class RecordedEvent(Message, name="r2p_msgs/RecordedEvent"):
    """Something that happened on the network (channel `/r2p/events`).

    | kind | what happened |
    | --- | --- |
    | `link up` | `link` is up: for the first time, or after `outage` seconds in which `count` messages were lost |
    | `link down`, `link waits` | `link` is down, or can't be set up yet; `text` says why |
    | `notice` | `text` about `link`; `notice` is its kind, for programs |
    | `master`, `no master` | `module` is the RTCAN master of the bus at `link`, or there is none |
    | `listening` | `link` accepts connections at the address `text` |
    | `mismatch` | peers have another type for `topic`, so nothing flows |
    | `module found`, `module changed` | `module` is new, or its state or version is another one: `text` |
    | `module gone`, `module silent` | `module` said good-bye, or was silent for its lease |
    | `name conflict` | two modules have the name `module` |
    | `no answer`, `answers` | `module` no longer answers the recorder, or again |
    | `events lost` | the recorder was too slow for `count` events |
    """

    kind: Annotated[str, Max(32)] = ""
    link: _Name = ""
    module: _Name = ""
    topic: _Name = ""
    notice: _Name = ""
    text: _Text = ""
    outage: f64 = 0.0
    count: u64 = 0


class RecordedSignal(Message, name="r2p_msgs/RecordedSignal"):
    """Messages that were missed, late, or lost (channel `/r2p/signals`).

    `kind` is "missed" (a message did not reach every subscriber in time), "late" (it was published or sent after its
    time), "degraded" (a link no longer meets the class of the publisher; `count` is 0), or "lost": dropped on the way
    by a subscriber, a link or a gateway, which `where` names.

    `source` says how it is known. "publisher": a signal of a publisher of the recording module, each one by itself with
    reason, `late` (s) and the message's `sequence` (0: unknown). "statistics": the statistics of a module have grown by
    `count` within the last `interval` seconds; the log of that module has reasons. Counts of the two never overlap:
    all signals with a kind, a module and a topic add up to the counters of that publisher while it was recorded.
    """

    kind: Annotated[str, Max(16)] = ""
    source: Annotated[str, Max(16)] = ""
    topic: _Name = ""
    module: _Name = ""
    node: _Name = ""
    publisher_class: u8 = 0
    reason: _Text = ""
    where: _Name = ""
    late: f64 = 0.0
    interval: f64 = 0.0
    count: u64 = 0
    sequence: u64 = 0


class BusState(Message, name="r2p_msgs/BusState"):
    """An RTCAN bus that the recording module is on, once a second (channel `/r2p/buses`).

    `master` is empty if there is none, or its name is not known. `own`: the recording module is the master. The UTC of
    an instant is the time of the network `epoch` plus `clock_offset`, with an error of at most `clock_error` (ns; -1:
    unknown).
    """

    link: _Name = ""
    up: bool = False
    master: _Name = ""
    own: bool = False
    epoch: i64 = 0
    network_time: i64 = 0
    clock_offset: i64 = 0
    clock_error: i64 = -1


class SlotOwner(Message, name="r2p_msgs/SlotOwner"):
    """The slots that a topic of a module has in each cycle; the master's sync is the topic `sync` in slot 0."""

    topic: _Name = ""
    module: _Name = ""
    slots: Annotated[tuple[i8, ...], Max(64)] = ()


class SlotTable(Message, name="r2p_msgs/SlotTable"):
    """Who owns which slot of an RTCAN bus (channel `/r2p/slots`), after each change and every ten seconds.

    The `cycle` (s) has `slots_in_cycle` slots of the same length. `bus` is the link of the module that watches it.
    """

    bus: _Name = ""
    cycle: f64 = 0.0
    slots_in_cycle: u8 = 0
    master: _Name = ""
    owners: Annotated[tuple[SlotOwner, ...], Max(256)] = ()


class LogRecord(Message, name="rcl_interfaces/Log"):
    """A log record of a node, as in ROS 2 (channel `/r2p/log`): `name` is MODULE/NODE, `level` as in Python's logging.

    `file`, `function` and `line` are not known.
    """

    stamp: Timestamp = Timestamp()
    level: u8 = 0
    name: _Name = ""
    msg: _Text = ""
    file: _Name = ""
    function: _Name = ""
    line: u32 = 0


class ParameterValue(Message, name="r2p_msgs/ParameterValue"):
    """The value of a parameter, at the beginning and after each change (channel `/r2p/parameters`).

    `value` is its text as in TOML, `number` the value as a number (1 for true; NaN where it is none), so that it can be
    plotted. `origin` says where the value comes from, such as "code" or "run time". `gone`: the module has it no more.
    """

    module: _Name = ""
    node: _Name = ""
    name: _Name = ""
    kind: Annotated[str, Max(16)] = ""
    value: Annotated[str, Max(VALUE_MAX)] = ""
    number: f64 = math.nan
    unit: _Name = ""
    origin: Annotated[str, Max(32)] = ""
    gone: bool = False


def cut(text: str, size: int = _NAME_MAX) -> str:
    """Return a text that is at most `size` bytes long in UTF-8: as much as a field of the messages holds."""
    data = text.encode(errors="replace")
    return text if len(data) <= size else data[:size].decode(errors="ignore")
