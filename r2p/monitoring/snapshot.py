"""The figures of a network at one time. Unknown figures are None.

Times are in seconds, sizes in bytes, rates per second. Counters count from the start of what they belong to.
"""

from collections.abc import Mapping

import msgspec

from r2p.runtime.sample import PublisherClass

CLASS_NAMES = {
    PublisherClass.PERIODIC: "periodic",
    PublisherClass.SPORADIC: "sporadic",
    PublisherClass.NON_REAL_TIME: "non real-time",
}
"""The classes of publishers in words."""


class Figures(msgspec.Struct, omit_defaults=True, gc=False):
    """The base of all figures, which have parts, but never their whole: JSON leaves out what is not known."""


class LatencyFigures(Figures):
    """The time from publishing to the arrival at this tool, over the last second: of `count` messages."""

    p50: float
    p99: float
    count: int


class PublisherFigures(Figures):
    """A publisher of a topic. `publisher_class` is "periodic", "sporadic" or "non real-time".

    `rate` is from the counter of its module: None where that does not answer.
    """

    module: str = ""
    node: str = ""
    link: str = ""
    publisher_class: str | None = None
    rate: float | None = None
    sent: int | None = None
    missed: int | None = None
    late: int | None = None


class SubscriberFigures(Figures):
    """A subscriber of a topic. `waiting` messages are in its queue; `lost` are those that it lost, by reason."""

    module: str = ""
    node: str = ""
    link: str = ""
    waiting: int | None = None
    lost: Mapping[str, int] | None = None


class TopicFigures(Figures):
    """A topic. `rate` and `bandwidth` are those of all of its publishers together.

    `rate_source` says how the rate is known: "counters" of the publishers' modules, "bus" (frames on an RTCAN bus), or
    "measured" by this tool, which has subscribed to the topic. `laxity`: the least time to a deadline with which a
    message was sent on a bus, below 0 after it. `missed` and `late` are counted by publishers; `lost_on_way` by links,
    gateways and subscribers, and by gaps in what is measured; `lost_here` by this tool.
    """

    name: str
    type: str | None = None
    size: int | None = None
    varies: bool = False
    mismatch: bool = False
    age: float | None = None
    publishers: tuple[PublisherFigures, ...] = ()
    subscribers: tuple[SubscriberFigures, ...] = ()
    rate: float | None = None
    rate_source: str | None = None
    bandwidth: float | None = None
    laxity: float | None = None
    latency: LatencyFigures | None = None
    missed: int | None = None
    late: int | None = None
    lost_on_way: int | None = None
    lost_here: int | None = None
    measured: bool = False
    is_of_service: bool = False


class NodeFigures(Figures):
    """A node of a module. Figures that its module leaves out of its report are None."""

    name: str
    running: bool | None = None
    restarts: int | None = None
    publishes: list[str] = msgspec.field(default_factory=list)
    subscribes: list[str] = msgspec.field(default_factory=list)


class ModuleFigures(Figures):
    """A module, as `ModuleView`. `cpu` is the share of a processor core that its process takes.

    `answers`: whether it has answered the last question for its statistics; None: it is never asked, as firmware.
    """

    name: str
    state: str
    kind: str
    age: float
    link: str = ""
    release: str | None = None
    rebooted: bool = False
    answers: bool | None = None
    uptime: float | None = None
    cpu: float | None = None
    nodes: list[NodeFigures] = msgspec.field(default_factory=list)


class LinkFigures(Figures):
    """A link of a module, counted by that module: messages and bytes per second in both directions, and losses."""

    module: str
    name: str
    up: bool = False
    ups: int | None = None
    waiting: int | None = None
    sent: float | None = None
    received: float | None = None
    bytes_sent: float | None = None
    bytes_received: float | None = None
    lost: Mapping[str, int] | None = None
    faults: Mapping[str, int] | None = None


class BusTopicFigures(Figures):
    """What a topic of a module takes of a bus: `share` of the time (1.0 is all), frames per second."""

    kind: str
    topic: str
    module: str
    share: float
    frames: float


class SlotFigures(Figures):
    """The owner of slots in the cycle of a bus. An empty topic: they are reserved and not used."""

    topic: str
    module: str
    slots: list[int]


class BusFigures(Figures):
    """An RTCAN bus. `share` of the time is used, `reserved` for slots; `free_used` of the other slots is used."""

    name: str
    master: str | None = None
    share: float | None = None
    frames: float | None = None
    errors: int | None = None
    reserved: float | None = None
    free_used: float | None = None
    topics: list[BusTopicFigures] = msgspec.field(default_factory=list)
    slots: list[SlotFigures] = msgspec.field(default_factory=list)
    slots_in_cycle: int | None = None
    cycle: float | None = None


class ServiceFigures(Figures):
    """A service, and the nodes that serve it (module/node); counters are sums over these."""

    name: str
    type: str | None = None
    servers: list[str] = msgspec.field(default_factory=list)
    running: int | None = None
    waiting: int | None = None
    handled: int | None = None
    failed: int | None = None
    refused: int | None = None


class NetworkSnapshot(Figures):
    """All figures at `time` (UTC, ns). `network` names the links of this tool.

    A row that is as in the snapshot before is the same object. `topics_left_out` counts those beyond the most topics
    that a snapshot has.
    """

    time: int
    network: str = ""
    modules: list[ModuleFigures] = msgspec.field(default_factory=list)
    topics: list[TopicFigures] = msgspec.field(default_factory=list)
    services: list[ServiceFigures] = msgspec.field(default_factory=list)
    links: list[LinkFigures] = msgspec.field(default_factory=list)
    buses: list[BusFigures] = msgspec.field(default_factory=list)
    topics_left_out: int = 0
