"""Attachments to a bus of another event loop by a connection: what programs see of it, and of servers that are not."""

from __future__ import annotations

import contextlib
import itertools
import os
import select
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from r2p.codecs.can_bits import INTERMISSION, Frame, OtherFrame, frame_bits
from r2p.errors import Closed, Error, MessageError, TransportError
from r2p.sim.buses import attach, channels, rendezvous, wire
from r2p.sim.buses import served as client_module
from r2p.sim.buses.attachment import FILTERS_MAX, TX_QUEUE, AttachmentOptions, BusFilter
from r2p.sim.buses.served import ServedAttachment, connect
from r2p.sim.buses.server import serve_bus
from r2p.sim.can import ControllerState
from r2p.sim.transport import SimCan
from tests.sim.buses.serving import PATIENCE, ServedInThread, served

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

BIT = 1_000  # ns


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def bus() -> Iterator[ServedInThread]:
    with served() as bus:
        yield bus


@contextlib.contextmanager
def attached(**options: object) -> Iterator[ServedAttachment]:
    attachment = connect("lab", AttachmentOptions(**options))  # type: ignore[arg-type]
    assert attachment is not None
    try:
        yield attachment
    finally:
        attachment.close()


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def frames_of(attachment: ServedAttachment, count: int) -> list[Frame]:
    found = []
    for _ in range(count):
        event = attachment.receive(PATIENCE)
        assert event is not None
        assert isinstance(event.frame, Frame)
        found.append(event.frame)
    return found


@pytest.mark.usefixtures("bus")
def test_programs_meet_and_stamps_are_exact() -> None:
    with attached(own=True) as a, attached() as b:
        assert (a.bitrate, a.node, b.node) == (1_000_000, "python-can", "python-can 2")
        sent = [Frame(0x100 + number, bytes(number % 9)) for number in range(1, 40)]
        for frame in sent:
            a.send(frame)
        ends = []
        for frame in sent:
            at_a, at_b = a.receive(PATIENCE), b.receive(PATIENCE)
            assert at_a is not None
            assert at_b is not None
            assert (at_a.frame, at_a.own, at_b.frame, at_b.own) == (frame, True, frame, False)
            assert (at_a.end, at_a.utc) == (at_b.end, at_b.utc)
            ends.append(at_a.end)
        b.send(Frame(1, b"back"))
        assert frames_of(a, 1) == [Frame(1, b"back")]
    shortest = [(frame_bits(each.id, each.data) + INTERMISSION) * BIT for each in sent[1:]]
    gaps = [after - before for before, after in itertools.pairwise(ends)]
    assert all(gap >= least for gap, least in zip(gaps, shortest, strict=True))
    assert any(gap == least for gap, least in zip(gaps, shortest, strict=True))  # some waited for the one before


def test_more_than_the_queue_goes_through_it(bus: ServedInThread) -> None:
    count = 5 * TX_QUEUE
    with attached() as a, attached() as b:
        for number in range(count):
            a.send(Frame(5, number.to_bytes(2, "big")))
        assert [int.from_bytes(each.data, "big") for each in frames_of(b, count)] == list(range(count))
        assert (a.lost, b.lost) == (0, 0)
    assert bus.can.bus.statistics.total.frames == count


@pytest.mark.usefixtures("bus")
def test_a_queue_that_no_frame_leaves_is_an_error() -> None:
    with attached() as alone:
        for _ in range(TX_QUEUE):
            alone.send(Frame(1, b""), 0)
        with pytest.raises(TimeoutError, match=r"lab: .*: the queue of 128 frames is full"):
            alone.send(Frame(1, b""), 0)
        wait_for(lambda: alone.state is ControllerState.PASSIVE)
        assert alone.error_counters == (128, 0)
        with pytest.raises(TimeoutError, match="the first one fails again and again"):
            alone.send(Frame(1, b""), 0.01)
        alone.flush()
        alone.send(Frame(2, b""), PATIENCE)
        with attached() as other:
            found = frames_of(other, 1)
            assert found in ([Frame(1, b"")], [Frame(2, b"")])  # one may have been on the wire


@pytest.mark.usefixtures("bus")
def test_filters_listen_only_and_the_names_of_nodes() -> None:
    with (
        attached(name="sender") as a,
        attached(listen_only=True, filters=(BusFilter(2, 2),)) as silent,
        attached() as other,
    ):
        assert a.node == "sender"
        assert (silent.state, silent.error_counters) == (ControllerState.ACTIVE, (0, 0))
        with pytest.raises(TransportError, match="only listens"):
            silent.send(Frame(1, b""))
        for identifier in (1, 2, 3):
            a.send(Frame(identifier, b""))
        assert frames_of(silent, 2) == [Frame(2, b""), Frame(3, b"")]
        silent.set_filters([BusFilter(1, 1)])
        frames_of(other, 3)
        a.send(Frame(4, b""))
        a.send(Frame(5, b""))
        assert frames_of(silent, 1) == [Frame(5, b"")]
        a.restart()  # in another state nothing happens


@pytest.mark.usefixtures("bus")
def test_what_no_call_receives_is_dropped_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    with attached() as a, attached(rx_queue=5) as slow, attached() as other:
        for number in range(20):
            a.send(Frame(number, b""))
        frames_of(other, 20)
        wait_for(lambda: slow.lost == 15)
        assert frames_of(slow, 5) == [Frame(number, b"") for number in range(15, 20)]
        assert slow.receive(0) is None
    assert "reads frames too late" in caplog.text


@pytest.mark.usefixtures("bus")
def test_a_descriptor_is_readable_while_there_is_an_event() -> None:
    with attached() as a, attached() as b:
        descriptor = b.fileno()
        assert select.select([descriptor], [], [], 0)[0] == []
        a.send(Frame(1, b""))
        a.send(Frame(2, b""))
        assert select.select([descriptor], [], [], PATIENCE)[0] == [descriptor]
        frames_of(b, 2)
        assert select.select([descriptor], [], [], 0)[0] == []


@pytest.mark.usefixtures("bus")
def test_close_wakes_calls_that_wait_and_all_others_raise() -> None:
    raised = []

    def wait(attachment: ServedAttachment) -> None:
        try:
            attachment.receive()
        except Closed as error:
            raised.append(error)

    with attached() as a:
        thread = threading.Thread(target=wait, args=(a,))
        thread.start()
        a.close()
        thread.join(PATIENCE)
        assert len(raised) == 1
        calls: list[Callable[[], object]] = [lambda: a.send(Frame(1, b"")), a.receive, a.flush, a.restart, a.fileno]
        for call in calls:
            with pytest.raises(Closed, match="the attachment to lab was closed"):
                call()
        a.close()


@pytest.mark.usefixtures("bus")
def test_frames_that_can_does_not_have_are_refused_and_the_attachment_goes_on() -> None:
    with attached() as a, attached() as b:
        for wrong in (Frame(1 << 29, b""), Frame(-1, b""), OtherFrame(0x800), OtherFrame(1, remote=16)):
            with pytest.raises(MessageError, match="does not fit a frame"):
                a.send(wrong)
        a.send(Frame(1, b""))
        assert frames_of(b, 1) == [Frame(1, b"")]


@pytest.mark.usefixtures("bus")
def test_a_descriptor_is_the_attachments_own_until_it_is_gone() -> None:
    with attached(states=False) as a, attached() as b:
        first = a.fileno()
        a.close()
        assert not select.select([first], [], [], 0)[0]
        second = b.fileno()
        child = os.fork()
        if child == 0:
            b.close()
            os._exit(0)
        os.waitpid(child, 0)
        assert second != first
        assert not select.select([second], [], [], 0)[0]  # the end of the copy is not that of the other one


def test_as_many_filters_as_linux_allows() -> None:
    filters = tuple(BusFilter(0xFFFF_FFFF - number, 0xFFFF_FFFF, extended=False) for number in range(FILTERS_MAX))
    with served(), attached(own=True) as a, attached(filters=filters) as b:
        a.send(Frame(1, b""))
        assert frames_of(a, 1) == [Frame(1, b"")]  # sent, and filtered
        b.set_filters(filters[1:])
        b.set_filters(filters)
        b.set_filters(())
        b.send(Frame(0, b""))  # after the filters, on one connection
        assert frames_of(a, 1) == [Frame(0, b"")]
        a.send(Frame(2, b""))
        assert frames_of(b, 1) == [Frame(2, b"")]
        with pytest.raises(MessageError, match="513 filters, of 512 at most"):
            b.set_filters([*filters, BusFilter(0, 0)])


def test_a_node_leaves_the_bus_with_its_program(bus: ServedInThread) -> None:
    with attached() as a:
        wait_for(lambda: list(bus.server.clients) == ["python-can"])
        a.close()
        wait_for(lambda: "python-can" not in bus.server.clients)


def test_the_end_of_the_server_is_said_after_what_was_received(bus: ServedInThread) -> None:
    with attached() as a, attached() as b:
        descriptor = b.fileno()
        a.send(Frame(1, b"last"))
        assert select.select([descriptor], [], [], PATIENCE)[0]
        bus.end()
        assert frames_of(b, 1) == [Frame(1, b"last")]
        calls: list[Callable[[], object]] = [lambda: b.receive(PATIENCE), lambda: b.send(Frame(1, b"")), b.flush]
        for call in calls:
            with pytest.raises(TransportError, match=r"the program that served the bus lab has ended .* r2p bus serve"):
                call()
        assert select.select([descriptor], [], [], 0)[0]
    assert connect("lab", AttachmentOptions()) is None


def test_what_the_server_refuses_is_said(bus: ServedInThread) -> None:
    with pytest.raises(TransportError, match="the bus lab has 1000000 bit/s, not 500000"):
        connect("lab", AttachmentOptions(bitrate=500_000))
    assert not bus.server.clients


def test_a_channel_is_a_served_bus_if_there_is_one(bus: ServedInThread) -> None:
    a, b = attach("lab"), attach("lab", AttachmentOptions(served=True))
    own = attach("lab", AttachmentOptions(served=False))
    try:
        assert isinstance(a, ServedAttachment)
        assert isinstance(b, ServedAttachment)
        assert not isinstance(own, ServedAttachment)
        again = attach("lab")  # a bus of this process comes first
        assert not isinstance(again, ServedAttachment)
        again.close()
        assert len(bus.server.clients) == 2
        assert "lab" in channels()
    finally:
        for each in (a, b, own):
            each.close()


def test_a_bus_that_no_program_serves() -> None:
    assert connect("lab", AttachmentOptions()) is None
    with pytest.raises(TransportError, match="no program serves the bus lab: start it with r2p bus serve lab, or"):
        attach("lab", AttachmentOptions(served=True))
    other = attach("no/file: so not served")
    assert not isinstance(other, ServedAttachment)
    other.close()


# Servers that are none


@contextlib.contextmanager
def stranger(answer: bytes | None) -> Iterator[None]:
    """Let another program listen at the port of a server that was killed; None: it says nothing."""
    done = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                if answer is None:
                    done.wait(PATIENCE)
                else:
                    connection.recv(1 << 16)
                    connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        with rendezvous.publish("lab", listening.getsockname()[1], bitrate=1_000_000):
            try:
                yield
            finally:
                done.set()
                thread.join(PATIENCE)


@pytest.mark.parametrize(
    "answer",
    [b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n", wire.encode_greeting(b"x" * wire.PROOF_SIZE, b"{}")],
    ids=["another protocol", "another secret"],
)
def test_a_stranger_at_the_port_is_no_bus(answer: bytes) -> None:
    with stranger(answer):
        assert connect("lab", AttachmentOptions()) is None


@pytest.mark.parametrize("answer", [b"", b"R2PB"])
def test_a_server_that_hangs_up_does_not_answer(answer: bytes) -> None:
    with stranger(answer), pytest.raises(TransportError, match="which serves the bus lab, does not answer: end it"):
        connect("lab", AttachmentOptions())


def test_a_server_that_is_silent_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "_ANSWER_TIMEOUT", 0.01)
    with stranger(None), pytest.raises(TransportError, match="does not answer"):
        connect("lab", AttachmentOptions())


def test_nobody_at_the_port_is_no_bus() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    with rendezvous.publish("lab", port, bitrate=1_000_000):
        assert connect("lab", AttachmentOptions()) is None


def test_garbage_of_a_server_ends_the_attachment(bus: ServedInThread) -> None:
    with attached() as a:
        [client] = bus.server.clients.values()
        bus.call(client._transport.write, b"\x05\xff\xff\xff\xff")
        with pytest.raises(TransportError, match="has ended"):
            a.receive(PATIENCE)


@pytest.mark.anyio
async def test_a_program_does_not_wait_for_itself() -> None:
    async with serve_bus(SimCan(), "lab"):
        with pytest.raises(Error, match="is served by this program, whose event loop would wait for itself"):
            attach("lab", AttachmentOptions(served=True))
