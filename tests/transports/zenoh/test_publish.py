"""What goes out at once, and what together with the others of a few turns of the event loop."""

import asyncio
from typing import Any

import msgspec
import pytest
import zenoh

from r2p.codecs import PublisherClass, attachment
from r2p.codecs.attachment import Origin
from r2p.messages import ClockOffset
from r2p.protocols.flow_control import SendWindow
from r2p.runtime.sample import Sample, Source
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.publish import BATCH_MAX, FLOOD, FLOOD_TURNS, Batcher, TxStream

pytestmark = pytest.mark.virtual_time

HERE = Source("PC1", "talk")
ELSEWHERE = Source("IMU", "", "rtcan:can0")
ORIGIN = Origin(PublisherClass.NON_REAL_TIME, 1, 1, bytes(8), "PC1", "talk")


class Wire:
    """Stands for zenoh: notes the payload of each packet, and the serials and sequences that its header stands for."""

    def __init__(self, *, batching: bool = True, varies: bool = False) -> None:
        self.sent: list[bytes] = []
        self.headers: list[attachment.Header] = []
        self.stats = LinkStats()
        self.batcher = Batcher(asyncio.get_running_loop(), self.stats, batching=batching)
        self.streams = {urgent: TxStream(SendWindow(), urgent=urgent) for urgent in (False, True)}
        for stream in self.streams.values():
            stream.varies = varies
            stream.prepare(HERE, ORIGIN, self.put)
        self.sequence = 0

    def put(self, data: bytes, *, attachment: bytes) -> None:
        if data[:1] == b"x":
            raise zenoh.ZError("closed")
        self.sent.append(data)
        self.headers.append(_decode(attachment))

    def add(self, data: bytes, *, urgent: bool = False, **fields: Any) -> None:
        """As a subscriber does it."""
        self.sequence += 1
        stream = self.streams[urgent]
        stream.window.serial += 1
        sample = Sample(data, HERE, 1000 + self.sequence, sequence=self.sequence)
        stream.samples.append(msgspec.structs.replace(sample, **fields))
        if urgent or len(stream.samples) in (1, BATCH_MAX):
            self.batcher.add(stream)


_decode = attachment.decode


async def turns(count: int) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


async def test_the_first_goes_at_once_the_others_together_and_the_urgent_never_wait() -> None:
    wire = Wire()
    for data in (b"1", b"2", b"3"):
        wire.add(data)
    wire.add(b"urgent", urgent=True)
    assert wire.sent == [b"1", b"urgent"]
    await turns(2)  # the second one brings nothing more
    assert wire.sent == [b"1", b"urgent", b"23"]
    assert (wire.headers[2].serial, wire.headers[2].sequence, wire.headers[2].more) == (2, 2, (1003,))
    assert (wire.stats.sent, wire.stats.bytes_sent) == (4, len("123urgent"))
    await turns(2)
    wire.add(b"4")
    assert wire.sent[-1] == b"4"


async def test_a_flood_goes_out_every_few_turns_and_when_it_ends() -> None:
    wire = Wire()
    wire.add(b"0")
    for _ in range(FLOOD_TURNS + 2):
        for _ in range(FLOOD):
            wire.add(b"1")
        await turns(1)
    assert wire.sent == [b"0", FLOOD_TURNS * FLOOD * b"1"]
    await turns(1)
    assert wire.sent[2:] == [2 * FLOOD * b"1"]


async def test_what_comes_slowly_does_not_wait_for_more() -> None:
    wire = Wire()
    wire.add(b"0")
    for _ in range(3):
        for _ in range(FLOOD - 1):
            wire.add(b"1")
        await turns(1)
    assert wire.sent == [b"0", *3 * [(FLOOD - 1) * b"1"]]


async def test_one_topic_can_be_sent_before_the_others() -> None:
    wire = Wire()
    other = TxStream(SendWindow(), urgent=False)
    other.prepare(HERE, ORIGIN, wire.put)
    for data in (b"0", b"1", b"2"):
        wire.add(data)
    wire.batcher.send(other)
    assert wire.sent == [b"0"]
    wire.batcher.send(wire.streams[False])
    wire.batcher.send(wire.streams[False])
    assert wire.sent == [b"0", b"12"]


async def test_a_turn_that_does_not_end_is_no_reason_to_keep_all_of_it() -> None:
    wire = Wire()
    for _ in range(1 + BATCH_MAX):
        wire.add(b"1")
    assert wire.sent == [b"1", BATCH_MAX * b"1"]
    assert not wire.streams[False].samples


async def test_a_link_that_goes_down_takes_along_what_waits() -> None:
    wire = Wire()
    for data in (b"1", b"2", b"3"):
        wire.add(data)
    assert wire.batcher.discard() == 2
    await turns(FLOOD_TURNS)
    assert wire.sent == [b"1"]
    wire.add(b"4")
    assert [each.serial for each in wire.headers] == [1, 2]  # it was counted here, so no other end has to


async def test_what_zenoh_does_not_take_is_counted() -> None:
    wire = Wire()
    for data in (b"1", b"x", b"y", b"long", b"2"):
        wire.add(data)
    wire.batcher.flush()
    assert wire.sent == [b"1", b"long", b"2"]
    assert [each.serial for each in wire.headers] == [1, 2, 3]  # they were counted here, so no other end has to
    assert wire.streams[False].window.serial == 3
    assert (wire.stats.sent, dict(wire.stats.lost)) == (3, {"link down": 2})


CLOCK = ClockOffset(1, 2, 3)


@pytest.mark.parametrize(
    ("changes", "packets"),
    [
        ([{}, {}, {}, {}], [b"abcd"]),
        ([{}, {"sequence": 2}, {}, {}], [b"a", b"b", b"cd"]),  # a latched value, once more
        ([{}, {"sequence": 9}, {"sequence": 10}, {"sequence": 11}], [b"a", b"bcd"]),  # others had no room
        ([{"sequence": 0}, {"sequence": 0}, {}, {"sequence": 0}], [b"ab", b"c", b"d"]),
        ([{}, {"deadline": 7}, {"deadline": 7}, {}], [b"a", b"bc", b"d"]),
        ([{"hops": 1}, {"hops": 1}, {"hops": 2}, {}], [b"ab", b"c", b"d"]),
        ([{}, {"stamped": False}, {"stamped": False}, {}], [b"a", b"bc", b"d"]),
        ([{"clock": CLOCK}, {"clock": CLOCK}, {"clock": ClockOffset(2, 2, 3)}, {}], [b"ab", b"c", b"d"]),
        ([{"source": ELSEWHERE}] * 4, [b"abcd"]),
    ],
)
async def test_what_shares_a_header(changes: list[dict[str, Any]], packets: list[bytes]) -> None:
    """Read one by one, the headers say of each message what was to be said of it."""
    wire = Wire()
    wire.add(b"0")
    expected = []
    for serial, (data, fields) in enumerate(zip((b"a", b"b", b"c", b"d"), changes, strict=True), 2):
        wire.add(data, **fields)
        each = wire.streams[False].samples[-1]
        hops = each.hops + bool(each.source.link)
        expected.append((serial, each.sequence, each.stamp, each.deadline, hops, each.stamped, each.clock))
    wire.batcher.flush()
    assert wire.sent[1:] == packets
    told = []
    for header in wire.headers[1:]:
        for at, stamp in enumerate((header.stamp, *header.more)):
            sequence = header.sequence + at if header.sequence else 0
            rest = header.deadline, header.hops, header.stamped, header.clock
            told.append((header.serial + at, sequence, stamp, *rest))
    assert told == expected


async def test_for_readers_that_know_nothing_of_r2p_each_message_is_a_payload() -> None:
    wire = Wire(batching=False)
    for data in (b"1", b"2", b"3"):
        wire.add(data)
    await turns(2)
    assert wire.sent == [b"1", b"2", b"3"]
    assert [each.serial for each in wire.headers] == [1, 2, 3]


async def test_long_messages_go_alone() -> None:
    wire = Wire()
    for size in (1, 5000, 5000, 5000, 5000, 20_000, 20_000):
        wire.add(bytes(size))
    wire.batcher.flush()
    assert [len(each) for each in wire.sent] == [1, 15_000, 5000, 20_000, 20_000]


async def test_messages_of_any_length_share_a_packet_whose_header_has_the_lengths() -> None:
    wire = Wire(varies=True)
    for data in (b"1", b"", b"22", b"333", bytes(16_383), b"4", bytes(20_000), b"5"):
        wire.add(data)
    wire.add(b"late", clock=CLOCK)
    wire.batcher.flush()
    lengths = [(1,), (0, 2, 3), (16_383, 1), (20_000,), (1,), (4,)]
    assert [each.lengths for each in wire.headers] == lengths
    assert [len(each) for each in wire.sent] == [sum(each) for each in lengths]
    assert [each.serial for each in wire.headers] == [1, 2, 5, 7, 8, 9]
    assert wire.headers[-1].clock == CLOCK


@pytest.mark.internal_errors
async def test_a_packet_that_raises_does_not_stop_the_others() -> None:
    wire = Wire()
    wire.add(b"0")
    wire.add(b"1", stamp=-(2**80))
    wire.add(b"22")
    wire.batcher.flush()
    assert wire.sent == [b"0", b"22"]
    assert [each.serial for each in wire.headers] == [1, 2]
    assert (wire.stats.sent, wire.stats.lost) == (2, {"internal error": 1})
