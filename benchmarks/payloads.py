"""zenoh's own two measurements by size of payload: what goes through, and there and back; r2p beside zenoh-python."""

import functools
from collections.abc import Iterator
from statistics import median
from typing import NamedTuple

from benchmarks.byte_links import Client, measure
from benchmarks.peers import rate_of
from benchmarks.table import Row, rate

SIZES = (8, 64, 512, 4_096, 32_768, 262_144, 1_048_576)
SECONDS = 0.5
ROUNDS = 300
OURS, BARE = "r2p over zenoh", "zenoh-python"


class Point(NamedTuple):
    """Of one size: messages a second, and the median there and back (s)."""

    size: int
    rate: float
    trip: float


async def _point(client: Client, size: int) -> Point:
    _, count = await client.stream(size, SECONDS)
    trips = await client.ping(size, ROUNDS if size < SIZES[-1] else ROUNDS // 6)
    return Point(size, rate_of(count), median(trips) if trips else 0.0)


def _measure(name: str, size: int) -> Point:
    return measure(name, functools.partial(_point, size=size), max(size, 64))


def rows() -> Iterator[Row]:
    for size in SIZES:
        mine, theirs = _measure(OURS, size), _measure(BARE, size)
        yield Row(
            f"zenoh, {mine.size} bytes: stream; there and back, p50",
            f"{rate(mine.rate)}; {mine.trip * 1e6:.0f} us",
            f"zenoh-python {rate(theirs.rate)}: {mine.rate / theirs.rate:.2f}x; "
            f"{theirs.trip * 1e6:.0f} us: {mine.trip / theirs.trip:.2f}x",
            "",
            None,
        )
