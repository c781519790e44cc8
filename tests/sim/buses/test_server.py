"""A server and its clients byte by byte, under virtual time: no sockets, and every instant is exact."""

from __future__ import annotations

import asyncio
import logging
import random
from typing import Any, cast

import msgspec
import pytest

from r2p.clock import clock_of
from r2p.codecs.can_bits import INTERMISSION, Frame, OtherFrame, other_frame_bits
from r2p.errors import Error
from r2p.sim.buses import server as server_module
from r2p.sim.buses import wire
from r2p.sim.buses.attachment import TX_QUEUE, AttachmentOptions, BusFilter, BusFrame
from r2p.sim.buses.rendezvous import SECRET_SIZE, ServedBus
from r2p.sim.buses.server import CLIENTS_MAX, EVENTS_KEPT, BusServer, ServedClient, serve_bus
from r2p.sim.can import ControllerState, ErrorKind
from r2p.sim.transport import SimCan

pytestmark = pytest.mark.virtual_time

SECRET = bytes(range(SECRET_SIZE))
BIT = 1_000  # ns


class Connection:
    """A client's end of a connection, which is also the server's transport."""

    def __init__(self, server: BusServer, *, greet: bool = True, **options: Any) -> None:
        self.written = bytearray()
        self.closed = False
        self.protocol: ServedClient = server.accept()
        self.protocol.connection_made(cast("asyncio.Transport", self))
        self.status: wire.Status | None = None
        if greet:
            self.greet(**options)

    # As a transport

    def set_write_buffer_limits(self, high: int) -> None:
        pass

    def write(self, data: bytes) -> None:
        self.written += data

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.protocol.connection_lost(None)

    abort = close

    # As a client

    def send(self, data: bytes) -> None:
        self.protocol.data_received(data)

    def greet(self, **options: Any) -> wire.BusDescription:
        self.send(hello(**options))
        body = self._greeting(SECRET[wire.PROOF_SIZE :])
        return msgspec.json.decode(body, type=wire.BusDescription)

    def refusal(self) -> str:
        assert self.closed
        return self._greeting(bytes(wire.PROOF_SIZE)).decode()

    def _greeting(self, proof: bytes) -> bytes:
        head = wire.decode_greeting(bytes(self.written[: wire.GREETING_SIZE]))
        assert head.proof == proof
        body = bytes(self.written[wire.GREETING_SIZE : wire.GREETING_SIZE + head.size])
        del self.written[: wire.GREETING_SIZE + head.size]
        return body

    def transmit(self, *frames: Frame | OtherFrame) -> None:
        self.send(wire.encode_message(wire.MessageType.SEND, wire.encode_frames(frames)))

    def events(self) -> list[BusFrame]:
        """What was received since the last call."""
        found = []
        while self.written:
            kind, size = wire.decode_head(self.written)
            assert kind == wire.MessageType.EVENTS
            body = bytes(self.written[wire.HEAD_SIZE : wire.HEAD_SIZE + size])
            del self.written[: wire.HEAD_SIZE + size]
            self.status = wire.decode_status(body)
            found += [wire.decode_event(each) for each in wire.event_records(body)]
        return found


def hello(proof: bytes = SECRET[: wire.PROOF_SIZE], **options: Any) -> bytes:
    return wire.encode_greeting(proof, msgspec.json.encode(AttachmentOptions(**options)))


def serving(can: SimCan | None = None) -> BusServer:
    return BusServer(can or SimCan(seed=1), ServedBus("lab", 0, 0, SECRET, 1_000_000))


async def test_stamps_are_those_of_the_bus() -> None:
    server = serving()
    a, b = Connection(server), Connection(server, own=True)
    await asyncio.sleep(1.0)
    frames: list[Frame | OtherFrame] = [Frame(0x123, b"abc"), OtherFrame(0x7FF, b""), OtherFrame(0x10, remote=5)]
    a.transmit(*frames[:2])
    b.transmit(frames[2])
    await asyncio.sleep(0.001)
    seen = b.events()
    assert [each.frame for each in seen] == [frames[0], frames[2], frames[1]]  # by arbitration, and by a's queue
    assert [each.own for each in seen] == [False, True, False]
    assert [each.utc - each.end for each in seen] == [clock_of().now() - clock_of().monotonic()] * 3
    assert seen[1].end - seen[0].end == (other_frame_bits(frames[2]) + INTERMISSION) * BIT
    assert [each.frame for each in a.events()] == [frames[2]]
    assert a.status is not None
    assert a.status.done == 2
    assert b.status is not None
    assert b.status.done == 1


async def test_a_client_learns_its_bus() -> None:
    server = serving(SimCan(bitrate=500_000, seed=1))
    await asyncio.sleep(2.0)
    first = Connection(server, greet=False).greet(bitrate=500_000)
    second = Connection(server, greet=False).greet()
    assert (first.bitrate, first.now, first.speed) == (500_000, 2_000_000_000, 1.0)
    assert [first.node, second.node] == ["python-can", "python-can 2"]
    assert list(server.clients) == ["python-can", "python-can 2"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"bitrate": 125_000}, "the bus lab has 1000000 bit/s, not 125000: open it with bitrate=1000000"),
        ({"name": "x" * 65}, "the name of a node has 64 characters at most"),
    ],
)
async def test_what_a_bus_does_not_offer_is_refused_in_words(options: dict[str, Any], text: str) -> None:
    server = serving()
    client = Connection(server, greet=False)
    client.send(hello(**options))
    assert client.refusal() == text
    assert not server.clients


@pytest.mark.parametrize("change", ["version", "options"])
async def test_another_version_is_refused_in_words(change: str) -> None:
    data = bytearray(hello())
    if change == "version":
        data[4] += 1
    else:
        data[-20:] = bytes(20)
    client = Connection(serving(), greet=False)
    client.send(bytes(data))
    assert client.refusal() == "the program that serves the bus lab has another version of r2p"


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        bytes(100),
        hello(proof=bytes(wire.PROOF_SIZE)),
        hello(proof=SECRET[wire.PROOF_SIZE :]),
        hello()[:-20] + b"\xff" * 20_000,
    ],
    ids=["HTTP", "zeros", "no secret", "the other half of the secret", "too long"],
)
async def test_strangers_are_hung_up_on(data: bytes, caplog: pytest.LogCaptureFixture) -> None:
    server = serving()
    client = Connection(server, greet=False)
    client.send(data)
    assert client.closed
    assert not client.written or b"another version" in client.written
    assert not server.clients


async def test_a_greeting_may_come_byte_by_byte_with_what_follows() -> None:
    server = serving()
    client, other = Connection(server, greet=False), Connection(server)
    data = hello() + wire.encode_message(wire.MessageType.SEND, wire.encode_frames([Frame(1, b"x")]))
    for byte in data:
        client.send(bytes([byte]))
    await asyncio.sleep(0.001)
    assert [each.frame for each in other.events()] == [Frame(1, b"x")]


async def test_a_connection_without_a_greeting_ends() -> None:
    server = serving()
    client = Connection(server, greet=False)
    client.send(hello()[:-1])
    await asyncio.sleep(4.9)
    assert not client.closed
    await asyncio.sleep(0.2)
    assert client.closed
    assert server.refused == 1


async def test_thousands_of_connections_keep_no_others_away(caplog: pytest.LogCaptureFixture) -> None:
    server = serving()
    strangers = [Connection(server, greet=False) for _ in range(3000)]
    assert sum(not each.closed for each in strangers) == 64
    assert server.refused == 3000 - 64
    assert len(caplog.records) == 5  # the rest is counted in the next line
    Connection(server).close()
    for _ in range(3000):
        Connection(server).close()
    assert len(server.can._unplugged) <= 2  # nodes are used again


async def test_so_many_programs_use_a_bus_and_no_more() -> None:
    server = serving()
    clients = [Connection(server) for _ in range(CLIENTS_MAX)]
    one_more = Connection(server, greet=False)
    one_more.send(hello())
    assert "64 programs use the bus lab" in one_more.refusal()
    clients[7].close()
    Connection(server)
    assert len(server.clients) == CLIENTS_MAX


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (wire.encode_message(cast("wire.MessageType", 99)), "unknown type 99"),
        (wire.encode_message(wire.MessageType.EVENTS), "unknown type 5"),
        (wire.encode_message(wire.MessageType.SEND, b"1234"), "no whole records"),
        (wire.encode_message(wire.MessageType.FILTERS, bytes(8) + b"\x03"), "unknown width"),
        (b"\x01\xff\xff\xff\xff", "at most"),
        (
            wire.encode_message(wire.MessageType.SEND, wire.encode_frames([Frame(1, b"")] * (TX_QUEUE + 1))),
            "more than 128",
        ),
    ],
)
async def test_a_client_that_does_not_keep_to_the_protocol_loses_its_node(
    message: bytes, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    server = serving()
    client = Connection(server)
    client.send(message)
    assert client.closed
    assert not server.clients
    assert text in caplog.text


async def test_garbage_after_the_greeting_never_hurts_the_others() -> None:
    server, numbers = serving(), random.Random(1)
    a, b = Connection(server), Connection(server)
    for _ in range(300):
        hostile = Connection(server)
        while not hostile.closed and numbers.random() < 0.9:
            hostile.send(bytes([numbers.randrange(7)]) + numbers.randbytes(numbers.randrange(60)))
        hostile.close()
    b.events()
    a.transmit(Frame(5, b"fine"))
    await asyncio.sleep(0.2)
    assert Frame(5, b"fine") in [each.frame for each in b.events()]


async def test_a_client_that_is_killed_in_the_middle_of_a_frame_has_no_power_from_there_on() -> None:
    server = serving()
    sender, other, third = Connection(server), Connection(server, errors=True), Connection(server)
    frame = Frame(0x1234567, b"12345678")
    start = clock_of().monotonic()
    sender.transmit(frame, frame)
    await asyncio.sleep(60e-6)
    sender.close()
    await asyncio.sleep(0.01)
    [error] = other.events()
    assert (error.error, error.own) == (ErrorKind.STUFF, False)
    assert 60 * BIT < error.end - start < 100 * BIT
    assert error.rx_errors == 1
    assert third.events() == []  # it asked for no errors, and there were no frames
    assert list(server.clients) == ["python-can 2", "python-can 3"]


async def test_a_client_that_does_not_read_loses_its_oldest_events(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "EVENTS_KEPT", 100)
    server = serving()
    sender, silent = Connection(server), Connection(server)
    silent.protocol.pause_writing()  # as asyncio does when the connection's buffer is full
    for number in range(250):
        sender.transmit(Frame(1, number.to_bytes(2, "big")))
        await asyncio.sleep(0.001)
    assert silent.events() == []
    silent.protocol.resume_writing()
    await asyncio.sleep(0)
    kept = silent.events()
    assert [int.from_bytes(each.frame.data, "big") for each in kept if each.frame] == list(range(150, 250))
    assert silent.status is not None
    assert silent.status.lost == 150


def test_all_events_that_are_kept_fit_one_message() -> None:
    assert EVENTS_KEPT <= wire.EVENTS_MAX


async def test_a_turn_of_the_loop_makes_one_message() -> None:
    server = serving()
    sender, other = Connection(server), Connection(server)
    sender.transmit(*[Frame(number, b"") for number in range(100)])
    await asyncio.sleep(0.1)
    assert len(other.events()) == 100


async def test_filters_flush_and_restart() -> None:
    server = serving()
    a, b = Connection(server), Connection(server, filters=(BusFilter(1, 1),))
    a.transmit(Frame(1, b""), Frame(2, b""))
    await asyncio.sleep(0.001)
    assert [each.frame for each in b.events()] == [Frame(1, b"")]
    b.send(wire.encode_message(wire.MessageType.FILTERS, wire.encode_filters([BusFilter(0, 1)])))
    a.transmit(Frame(1, b""), Frame(2, b""), Frame(4, b""))
    a.send(wire.encode_message(wire.MessageType.FLUSH))
    await asyncio.sleep(0.001)
    assert b.events() == []  # the first one was about to start, the others were dropped
    a.events()
    assert a.status is not None
    assert a.status.done == 5
    a.send(wire.encode_message(wire.MessageType.RESTART))  # in another state: nothing happens
    assert not a.closed


async def test_a_client_learns_the_state_of_its_controller() -> None:
    server = serving()
    alone = Connection(server)
    alone.transmit(Frame(1, b""))
    await asyncio.sleep(0.1)
    [change] = alone.events()
    assert (change.state, change.tx_errors, change.frame) == (ControllerState.PASSIVE, 128, None)
    assert alone.status is not None
    assert (alone.status.state, alone.status.done, alone.status.tx_errors) == (ControllerState.PASSIVE, 0, 128)
    listener = Connection(server, listen_only=True, errors=True)
    await asyncio.sleep(0.001)
    # It does not acknowledge, and a sender that is error passive has invisible error flags: all frames look good.
    assert {(each.frame, each.error) for each in listener.events()} == {(Frame(1, b""), None)}
    Connection(server)
    await asyncio.sleep(0.001)
    alone.events()
    assert alone.status.done == 1


async def test_the_end_of_the_server_disconnects_all() -> None:
    server = serving()
    clients = [Connection(server), Connection(server, greet=False)]
    server.close()
    assert all(each.closed for each in clients)
    assert not server.clients


async def test_joins_and_leaves_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "r2p"):
        Connection(serving(), name="tester").close()
    assert [each.getMessage() for each in caplog.records] == ["bus lab: tester joins", "bus lab: tester leaves"]


async def test_virtual_time_that_does_not_wait_can_not_be_served() -> None:
    with pytest.raises(Error, match="give it a speed"):
        await serve_bus(SimCan(seed=1), "lab").__aenter__()
