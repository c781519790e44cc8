"""Programs of python-can on the exact bus, unchanged: viewer, logger, player, bridge; and what they see of errors."""

import asyncio
import functools
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import can.bridge
import can.player
import pytest

from r2p.testing.exact_bus import ExactBus
from tests.docs.shell import Process

SOON = 20.0  # seconds: for what happens at once, unless the computer is busy
TURN = 0.02  # seconds that stopping a notifier may take
BUS_OFF, COUNTERS, NO_ACKNOWLEDGE, BUS_ERROR = 0x40, 0x200, 0x20, 0x80  # linux/can/error.h

VIEWER = """
import can, sys
from can import viewer
with can.Bus(interface="r2psim", channel="viewer", served=False) as motor:
    motor.send_periodic(can.Message(arbitration_id=0x123, data=bytes.fromhex("CAFE"), is_extended_id=False), 0.01)
    sys.argv = ["can_viewer", "-i", "r2psim", "-c", "viewer"]
    viewer.main()
"""


def message(identifier: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, **more)


MESSAGES = [
    message(0x7FF, b"standard", is_extended_id=False),
    message(0x1FFFFFFF, bytes(range(8))),
    message(1, b""),
    message(0, b"\0", is_extended_id=False),
    message(0x7FF, b"again", is_extended_id=False),
    message(0x321, is_extended_id=False, is_remote_frame=True, dlc=0),
]


def same(found: can.Message | None, sent: can.Message) -> bool:
    return found is not None and found.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)


def assert_received(receiver: can.BusABC, messages: list[can.Message] = MESSAGES) -> None:
    """Receive these messages in this order."""
    for each in messages:
        found = receiver.recv(SOON)
        assert same(found, each), f"{found}, not {each}"


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_the_viewer_shows_a_frame(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(VIEWER)
    viewer = Process(f"{sys.executable} program.py", tmp_path, {"TERM": "xterm", "LINES": "24", "COLUMNS": "80"})
    try:
        viewer.expect(re.compile(r".*Count.*0x123.*2.*CA.*FE", re.DOTALL))
        viewer.type("q")
        viewer.finish(0)
    finally:
        viewer.close()


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".log", ".trc"])
def test_what_the_logger_writes_the_player_sends(
    exact_bus: ExactBus, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / f"run{suffix}"
    sender, recorder, receiver = (exact_bus.open() for _ in range(3))
    finished = can.BufferedReader()
    messages = MESSAGES[:-1] if suffix == ".trc" else MESSAGES  # python-can writes no remote frames there
    with can.Notifier(recorder, [can.Logger(file), finished], TURN):  # it stops the logger, too
        for each in messages:
            sender.send(each)
        assert all(same(finished.get_message(SOON), each) for each in messages)
    assert_received(receiver, messages)

    command = ["can_player", "-i", "r2psim", "-c", exact_bus.channel, str(file)]
    monkeypatch.setattr(sys, "argv", command)
    can.player.main()
    assert_received(receiver, messages)


@pytest.mark.virtual_time
async def test_a_log_has_the_order_in_which_the_arbitration_was_won(exact_bus: ExactBus, tmp_path: Path) -> None:
    nodes = [exact_bus.open() for _ in range(3)]
    identifiers = [(0x300, 0x10), (0x200, 0x20), (0x100, 0x30)]  # each node sends its own in their order
    loop = asyncio.get_running_loop()
    with can.Notifier(exact_bus.open(listen_only=True), [can.Logger(tmp_path / "run.log")], loop=loop):
        for node, both in zip(nodes, identifiers, strict=True):
            for identifier in both:
                node.send(message(identifier, is_extended_id=False))
        await asyncio.sleep(0.01)
    lines = (tmp_path / "run.log").read_text().splitlines()
    assert [line.split()[2] for line in lines] == ["100#", "030#", "200#", "020#", "300#", "010#"]


@pytest.mark.virtual_time
async def test_a_log_has_the_error_frames(exact_bus: ExactBus, tmp_path: Path) -> None:
    motor = exact_bus.open("motor")
    exact_bus.disturb_next(2, sender=motor)
    loop = asyncio.get_running_loop()
    observer = exact_bus.open(berr_reporting=True)
    with can.Notifier(observer, [can.Logger(tmp_path / "run.asc")], loop=loop):
        motor.send(message(0x123, b"\1\2", is_extended_id=False))
        await asyncio.sleep(0.01)
    assert [each.senders for each in exact_bus.errors] == [("motor",)] * 2
    with can.LogReader(tmp_path / "run.asc") as log:
        found = list(log)
    assert [each.is_error_frame for each in found] == [True, True, False]
    assert found[2].arbitration_id == 0x123
    assert "ErrorFrame" in (tmp_path / "run.asc").read_text()


def test_a_replay_has_the_order_of_the_recording(exact_bus: ExactBus) -> None:
    sender, receiver = exact_bus.open(), exact_bus.open()
    recorded = [message(9 - number, bytes([number]), timestamp=number * 0.01) for number in range(5)]
    for each in can.MessageSync(recorded):
        sender.send(each)
    assert_received(receiver, recorded)


def test_the_bridge_joins_two_buses(exact_bus: ExactBus, monkeypatch: pytest.MonkeyPatch) -> None:
    other = ExactBus()
    a, b = exact_bus.open(), other.open()
    waits: list[float] = []

    def exchange(seconds: float) -> None:
        """What happens while the bridge sleeps; then Ctrl-C."""
        waits.append(seconds)
        for sender, receiver in ((a, b), (b, a)):
            for each in MESSAGES:
                sender.send(each)
            assert_received(receiver)
        raise KeyboardInterrupt

    command = "can_bridge --bus1-interface r2psim --bus1-channel {} --bus2-interface r2psim --bus2-channel {}"
    monkeypatch.setattr(sys, "argv", command.format(exact_bus.channel, other.channel).split())
    monkeypatch.setattr("can.bridge.time.sleep", exchange)
    monkeypatch.setattr("can.bridge.Notifier", functools.partial(can.Notifier, timeout=TURN))
    try:
        can.bridge.main()
    finally:
        monkeypatch.undo()
        other.close()
    assert waits == [1]


# Errors


def errors_of(node: can.BusABC) -> Iterator[can.Message]:
    """Error messages as they come, forever."""
    while True:
        found = node.recv(SOON)
        assert found is not None, "there is no error message"
        if found.is_error_frame:
            yield found


def test_a_program_sees_bus_off_and_leaves_it(exact_bus: ExactBus) -> None:
    program, other = exact_bus.open(), exact_bus.open()
    exact_bus.noise = 1.0
    program.send(message(0x42))
    counters = []
    for each in errors_of(program):
        counters.append(each.data[6])
        if each.arbitration_id & BUS_OFF:
            break
    assert program.state is can.BusState.ERROR
    assert counters[0] > 127  # it was error passive first
    with pytest.raises(can.CanOperationError, match="bus off"):
        program.send(message(0x43))

    exact_bus.noise = 0.0
    program.state = can.BusState.ACTIVE  # what waits in its queue is sent now
    while (found := other.recv(SOON)) is not None and found.is_error_frame:
        pass
    assert found is not None
    assert found.arbitration_id == 0x42
    assert program.state is can.BusState.ACTIVE


def test_a_node_that_is_alone_becomes_passive_until_another_one_comes(exact_bus: ExactBus) -> None:
    alone = exact_bus.open(berr_reporting=True)
    alone.send(message(0x42))
    assert any(each.arbitration_id & NO_ACKNOWLEDGE for each in errors_of(alone))
    assert any(each.data[1] for each in errors_of(alone))
    assert alone.state is can.BusState.PASSIVE
    other = exact_bus.open(ignore_rx_error_frames=True)
    found = other.recv(SOON)
    assert found is not None
    assert found.arbitration_id == 0x42


def test_a_program_does_not_notice_a_noisy_bus(exact_bus: ExactBus) -> None:
    exact_bus.noise, exact_bus.seed = 0.3, 11
    sender, receiver = exact_bus.open(), exact_bus.open(ignore_rx_error_frames=True)
    for number in range(100):
        sender.send(message(number))
    assert [getattr(receiver.recv(SOON), "arbitration_id", None) for _ in range(100)] == list(range(100))
    assert len(exact_bus.errors) > 10


def test_a_cut_wire_holds_frames_back(exact_bus: ExactBus) -> None:
    sender, receiver = exact_bus.open(), exact_bus.open(ignore_rx_error_frames=True)
    exact_bus.cut_wire(sender)
    sender.send(message(7))
    assert next(errors_of(sender)).arbitration_id & COUNTERS  # error passive: nobody acknowledges
    assert receiver.recv(0) is None
    exact_bus.mend_wire(sender)
    assert same(receiver.recv(SOON), message(7))
