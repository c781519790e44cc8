"""Sets of messages: the thesis's, those of the literature, those of cars, and random ones. Times in ns."""

from __future__ import annotations

import csv
import random
from functools import cache
from pathlib import Path

import msgspec

from r2p.codecs.can_bits import FRAME_MAX, INTERMISSION
from r2p.units import MILLISECOND, SECOND

_SETS = Path(__file__).parent / "sets"
SPORADIC_SLACK = 0.25
"""Mean of the random time by which an event is later than its least interval, as a share of that."""


class SetMessage(msgspec.Struct, frozen=True):
    """One message of a set. `period`: of an event, the least time between two; `slack`: mean of what comes on top.

    `deadline`: from the release to the end of the last frame; `jitter`: of the release.
    """

    name: str
    node: str
    size: int
    period: int
    deadline: int
    jitter: int = 0
    sporadic: bool = False
    slack: int = 0

    @property
    def interval(self) -> int:
        """Mean time between two."""
        return self.period + self.slack


class MessageSet(msgspec.Struct, frozen=True):
    """Messages on one bus of `bitrate` bit/s."""

    name: str
    bitrate: int
    messages: tuple[SetMessage, ...]

    @property
    def nodes(self) -> list[str]:
        """Names of all nodes, in the order of their first message."""
        return list(dict.fromkeys(each.node for each in self.messages))

    @property
    def load(self) -> float:
        """Share of the bus that the messages need, in frames of 11-bit identifiers with the most stuff bits."""
        needs = (frames_ns(each.size, self.bitrate) / each.interval for each in self.messages)
        return sum(needs)

    def by_deadline(self) -> list[SetMessage]:
        """Return all messages, the one with the shortest deadline first (deadline-monotonic)."""
        return sorted(self.messages, key=lambda each: (each.deadline, each.period, each.name))

    def by_rate(self) -> list[SetMessage]:
        """Return all messages, the one with the shortest period first (rate-monotonic)."""
        return sorted(self.messages, key=lambda each: (each.interval, each.deadline, each.name))


def longest_bits(size: int, *, extended: bool = False) -> int:
    """Bits of the longest data frame, intermission included (Davis et al. 2007, equation for C)."""
    ahead = 54 if extended else 34
    return ahead + 8 * size + 10 + INTERMISSION + (ahead + 8 * size - 1) // 4


def frames_ns(size: int, bitrate: int, *, extended: bool = False) -> int:
    """Time of all frames of a message of `size` bytes at most, in ns."""
    sizes = [min(FRAME_MAX, size - done) for done in range(0, size, FRAME_MAX)]
    return sum(longest_bits(each, extended=extended) for each in sizes) * SECOND // bitrate


def load_csv(file: str, bitrate: int) -> MessageSet:
    """Load a set of `sets/`. Messages of type S, and those that a car also sends at events, are sporadic."""
    with (_SETS / file).open() as lines:
        rows = list(csv.DictReader(lines))
    return MessageSet(file.removesuffix(".csv"), bitrate, tuple(_message(row, file) for row in rows))


_SPORADIC = {("sae_17_piggyback_2byte.csv", "m17"), ("sae_17_piggyback_2byte.csv", "m7")}


def _message(row: dict[str, str], file: str) -> SetMessage:
    period, deadline, jitter = (
        round(float(row[name]) * MILLISECOND) for name in ("period_ms", "deadline_ms", "jitter_ms")
    )
    sporadic = row.get("send_type") == "EventPeriodic" or (file, row["name"]) in _SPORADIC
    slack = round(SPORADIC_SLACK * period) if sporadic else 0
    return SetMessage(row["name"], row["node"], int(row["bytes"]), period, deadline, jitter, sporadic, slack)


def thesis(load: float = 0.8) -> MessageSet:
    """Section 4.4 of the thesis: three nodes with three periodic messages each, and events of three kinds.

    `load`: events, as a share of the 20 slots of 60 that RTCAN leaves free. Events have no least interval.
    """
    slot, free = 166_000, 20 / 60
    kinds = (("SA", 8, 20, 5.26), ("SB", 16, 20, 2.03), ("SC", 10, 50, 1.0))
    slots = sum(weight * -(-size // FRAME_MAX) for _, size, _, weight in kinds)
    rate = load * free * SECOND / slot / slots / 3  # events of kind SC a second, at each node
    messages = []
    for node in "123":
        for name, ms in (("HA", 1), ("HB", 5), ("HC", 10)):
            period = 996_000 * ms
            messages.append(SetMessage(f"{name}{node}", node, FRAME_MAX, period, period))
        for name, size, ms, weight in kinds:
            gap = round(SECOND / (rate * weight))
            messages.append(SetMessage(f"{name}{node}", node, size, 0, ms * MILLISECOND, 0, sporadic=True, slack=gap))
    return MessageSet(f"thesis 4.4, events {load:.0%}", 1_000_000, tuple(messages))


def table_4_1() -> MessageSet:
    """Table 4.1 of the thesis, a balancing robot: two motors. Rates and deadlines of events are assumed."""

    def hard(name: str, node: str, size: int, ms: int) -> SetMessage:
        return SetMessage(name, node, size, ms * MILLISECOND, ms * MILLISECOND)

    def event(name: str, node: str, size: int, ms: int, deadline: int) -> SetMessage:
        return SetMessage(
            name, node, size, ms * MILLISECOND, deadline * MILLISECOND, sporadic=True, slack=ms * MILLISECOND // 4
        )

    messages = (
        hard("torque left", "control", 2, 1),
        hard("torque right", "control", 2, 1),
        hard("speed left", "control", 2, 10),
        hard("speed right", "control", 2, 10),
        hard("angle", "imu", 10, 10),
        hard("odometry", "control", 4, 100),
        event("obstacles", "proximity", 8, 20, 10),
        event("waypoint", "planner", 36, 100, 50),
    )
    return MessageSet("thesis table 4.1", 1_000_000, messages)


_PERIODS = (2, 5, 10, 20, 50, 100)
_RANDOM_NODES = 8
_SPORADIC_SHARE = 0.3


def random_set(seed: int, load: float, bitrate: int = 1_000_000) -> MessageSet:
    """Random messages of 1 to 8 bytes of 8 nodes, with D = T, up to `load` of the bus; three in ten are sporadic.

    Each is drawn from {2, 5, 10, 20, 50, 100} ms, as control loops of robots have them.
    """
    numbers = random.Random(f"set {seed}/{load}")
    messages: list[SetMessage] = []
    used = 0.0
    while used < load:
        period = numbers.choice(_PERIODS) * MILLISECOND
        size = numbers.randint(1, FRAME_MAX)
        sporadic = numbers.random() < _SPORADIC_SHARE
        slack = round(SPORADIC_SLACK * period) if sporadic else 0
        share = frames_ns(size, bitrate) / (period + slack)
        if used + share > load + 0.005:
            period, slack = 100 * MILLISECOND, 25 * MILLISECOND if sporadic else 0
            share = frames_ns(size, bitrate) / (period + slack)
        node = f"n{numbers.randrange(_RANDOM_NODES)}"
        messages.append(SetMessage(f"r{len(messages)}", node, size, period, period, 0, sporadic, slack))
        used += share
    return MessageSet(f"random {load:.0%}", bitrate, tuple(messages))


def least_busy(busy: list[int], every: int) -> int:
    """Return the offset below `every` whose cycles, one in `every`, are the least busy ones."""
    return min(range(min(every, len(busy))), key=lambda offset: max(busy[offset::every]))


@cache
def named_set(name: str, seed: int = 1) -> MessageSet:
    """Return a set by its short name; only random ones depend on `seed`."""
    if name.startswith("random-"):
        return random_set(seed, int(name.removeprefix("random-")) / 100)
    if name.startswith("thesis-"):
        return thesis(int(name.removeprefix("thesis-")) / 100)
    if name == "table-4.1":
        return table_4_1()
    file, bitrate = FILES[name]
    return load_csv(file, bitrate)


FILES = {
    "sae": ("sae_17_piggyback_2byte.csv", 500_000),
    "broster": ("broster12_250k.csv", 250_000),
    "davis": ("davis_counterexample_125k.csv", 125_000),
    "ford": ("ford_fd1_2019_periodic.csv", 500_000),
    "vw": ("vw_mqb_rates.csv", 500_000),
    "hyundai": ("hyundai_rates.csv", 500_000),
    "j1939": ("j1939_truck_rates.csv", 250_000),
}
"""Files of `sets/`, with the bit rate that the study gives them."""
