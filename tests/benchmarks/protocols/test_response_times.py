"""Plain CAN on the simulated bus beside published response times: the bus is that of the literature.

The published numbers are responses to the last bit of the frame, without the intermission, as those of `r2p.analysis`.
"""

from __future__ import annotations

import asyncio
import csv
import itertools
import random
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import pytest

from benchmarks.protocols import message_sets
from benchmarks.protocols.fixed_priority import FIRST_IDENTIFIER, PlainCan
from benchmarks.protocols.message_sets import MessageSet, SetMessage, longest_bits, named_set
from benchmarks.protocols.network import ProtocolSetup
from r2p.analysis import BusMessage, bit_time, response_bounds
from r2p.codecs.can_bits import INTERMISSION, OtherFrame, frame_bits
from r2p.sim import run
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

BROSTER = named_set("broster")
_FILE = Path(message_sets.__file__).parent / "sets" / "broster12_250k.csv"


class InFileOrder(PlainCan):
    title = "in the order of the file"

    def order(self) -> Sequence[SetMessage]:
        return self.set.messages

    def release(self, message: str, at: int) -> None:
        """Release a value at this instant."""
        box = next(box for boxes in self.boxes.values() for box in boxes if box.message.name == message)
        self.bus.timeline.at(at, lambda: box.put(box.track.release(at)))


def response_times(messages: MessageSet) -> list[int | None]:
    """Return the worst-case response times by `r2p.analysis` (ns), with priorities in the order of the set."""
    found = response_bounds(
        [
            BusMessage(name=each.name, size=each.size, period=each.period, deadline=each.deadline, id=place)
            for place, each in enumerate(messages.messages)
        ],
        bit_time(messages.bitrate),
    )
    return [each.bound for each in found]


@cache
def most_stuffed(identifier: int, size: int) -> bytes:
    """Return a payload with as many stuff bits as can be found: runs of four bits, in all phases."""
    numbers = random.Random(identifier)
    runs = [0x0F0F >> shift & 0xFF for shift in range(8)]
    tried = [bytes(each) for each in itertools.product(runs, repeat=min(size, 2))]
    tried = [each + bytes(numbers.choices(runs, k=size - len(each))) for each in tried * 8]
    return max(tried, key=lambda data: frame_bits(identifier, data, extended=False))


def still(messages: MessageSet) -> ProtocolSetup:
    """No jitter, exact clocks, nothing dropped."""
    return ProtocolSetup(messages=messages, ppm=0.0, latency=0, jitter=0, drop=False)


async def critical_instant(place: int) -> int:
    """Return the response of one message if all above it are released just after the longest one below has started."""
    network = InFileOrder(still(BROSTER))
    network.start()
    network.bus.timeline.close()  # no releases but ours
    for boxes in network.boxes.values():
        for box in boxes:
            rank = BROSTER.messages.index(box.message)
            box._make = partial(_stuffed, FIRST_IDENTIFIER + rank)
    below = BROSTER.messages[place + 1 :]
    at = network.bus.timeline.now() + MILLISECOND
    if below:
        network.release(max(below, key=lambda each: each.size).name, at)
    for message in BROSTER.messages[: place + 1]:
        network.release(message.name, at + network.bus.bit + 1)
    await asyncio.sleep(0.01)
    instance = network.tracks[BROSTER.messages[place].name].instances[0]
    network.close()
    return instance.end - instance.released


def _stuffed(identifier: int, _instance: object, payload: bytes) -> OtherFrame:
    return OtherFrame(identifier, most_stuffed(identifier, len(payload)))


def published() -> list[int]:
    with _FILE.open() as lines:
        return [round(float(row["expected_wctt_ms_250k"]) * MILLISECOND) for row in csv.DictReader(lines)]


def test_the_analysis_gives_the_published_response_times() -> None:
    assert response_times(BROSTER) == published()


@pytest.mark.parametrize("place", range(12))
def test_the_simulated_worst_case_is_just_below_the_published_response_time(place: int) -> None:
    simulated = run(partial(critical_instant, place))
    bound = published()[place]
    assert 0.9 * bound < simulated <= bound


def test_random_phases_never_exceed_the_published_response_times() -> None:
    async def main() -> list[int]:
        network = InFileOrder(ProtocolSetup(messages=BROSTER, latency=0, jitter=0, drop=False))
        network.start()
        await asyncio.sleep(1)
        worst = [
            max(each.end - each.released for each in network.tracks[message.name].instances if each.end)
            for message in BROSTER.messages
        ]
        network.close()
        return worst

    for simulated, bound in zip(run(main), published(), strict=True):
        assert simulated <= bound


def test_the_counterexample_misses_in_the_second_instance() -> None:
    """Frames of the longest form can't be had, so the example is scaled to frames of one length that can."""
    davis = named_set("davis")
    assert [longest_bits(each.size) for each in davis.messages] == [125] * 3
    bit = SECOND // davis.bitrate
    assert response_times(davis) == [(2 * 125 - 3) * bit, (3 * 125 - 3) * bit, 3_500_000]

    length = 110
    scaled = [
        msgspec.structs.replace(each, period=each.period * length // 125, deadline=each.deadline * length // 125)
        for each in davis.messages
    ]
    messages = msgspec.structs.replace(davis, messages=tuple(scaled))

    async def main() -> list[int]:
        network = InFileOrder(still(messages))
        network.start()
        network.bus.timeline.close()
        start = network.bus.timeline.now() + MILLISECOND
        for place, message in enumerate(scaled):
            box = network.boxes[message.node][0]
            box._make = partial(_of_length, FIRST_IDENTIFIER + place, length - INTERMISSION)
            for number in range(3):
                network.release(message.name, start + number * message.period)
        await asyncio.sleep(0.02)
        responses = [each.end - each.released for each in network.tracks["C"].instances]
        network.close()
        return responses

    first, second, _ = run(main)
    deadline = scaled[2].deadline
    assert first <= deadline < second
    assert second == (7 * length - INTERMISSION) * bit - scaled[2].period


def _of_length(identifier: int, bits: int, _instance: object, payload: bytes) -> OtherFrame:
    """Return a frame with exactly so many bits."""
    numbers = random.Random(identifier)
    while frame_bits(identifier, payload, extended=False) != bits:
        payload = numbers.randbytes(len(payload))
    return OtherFrame(identifier, payload)
