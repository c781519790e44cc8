"""The fixture `exact_bus`: a CAN bus in software for tests of programs that use python-can."""

import asyncio
import os
import sys
from typing import Any

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from r2p.errors import Error, MessageError
from r2p.sim.can import ErrorKind
from r2p.sim.transport import running_buses
from r2p.testing.exact_bus import ExactBus
from tests.testing.test_plugin import outcomes
from tests.testing.test_plugin import project as project

SOON = 20.0


def message(identifier: int = 1, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, **more)


def received(node: can.BusABC) -> can.Message:
    found = node.recv(SOON)
    assert found is not None
    return found


def test_nodes_meet_and_frames_are_recorded(exact_bus: ExactBus) -> None:
    motor, panel = exact_bus.open("motor"), exact_bus.open()
    motor.send(message(0x123, b"hello"))
    panel.send(message(0x7, is_extended_id=False))
    assert received(panel).data == b"hello"
    assert received(motor).arbitration_id == 7
    frames = exact_bus.frames
    assert {(each.frame.id, each.frame.extended, each.senders) for each in frames} == {
        (0x123, True, ("motor",)),
        (0x7, False, ("node2",)),
    }
    assert frames[0].end <= frames[1].start
    assert exact_bus.errors == []
    assert exact_bus.records == frames
    assert 0.0 < exact_bus.load() < 1.0


def test_a_program_finds_it_by_its_channel(exact_bus: ExactBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "r2psim")
    monkeypatch.setenv("CAN_CHANNEL", exact_bus.channel)
    with can.Bus() as program:  # as a program does that is configured from outside
        program.send(message(5))
        assert received(exact_bus.open()).arbitration_id == 5
        exact_bus.power_off("python-can")  # its name, as it has asked for none
        assert program.state is can.BusState.ERROR


def test_each_has_a_name_of_its_own() -> None:
    a, b = ExactBus(), ExactBus()
    assert a.channel != b.channel
    assert {name for name, _ in running_buses()} >= {a.channel, b.channel}
    for each in (a, b):
        each.close()
        each.close()
    assert not {name for name, _ in running_buses()} & {a.channel, b.channel}
    assert str(os.getpid()) in a.channel  # programs of several tests, at once, on one computer


def test_its_bit_rate_and_seed_are_set_first(exact_bus: ExactBus) -> None:
    exact_bus.bitrate, exact_bus.seed = 125_000, 5
    with pytest.raises(MessageError, match="does not take whole nanoseconds"):
        exact_bus.bitrate = 299_999
    node: Any = exact_bus.open()
    assert node.bitrate == exact_bus.bitrate == 125_000
    with pytest.raises(Error, match="exact_bus runs already: set its bitrate before"):
        exact_bus.bitrate = 250_000
    with pytest.raises(Error, match="exact_bus runs already: set its seed before"):
        exact_bus.seed = 6
    assert exact_bus.seed == 5


def test_noise_may_be_set_at_any_time(exact_bus: ExactBus) -> None:
    sender, receiver = exact_bus.open(), exact_bus.open(ignore_rx_error_frames=True)
    with pytest.raises(MessageError, match="noise is a share"):
        exact_bus.noise = 2.0
    exact_bus.noise = 0.3
    for number in range(50):
        sender.send(message(number))
    assert [received(receiver).arbitration_id for _ in range(50)] == list(range(50))
    assert exact_bus.noise == 0.3
    noisy = len(exact_bus.errors)
    assert noisy > 0
    exact_bus.noise = 0.0
    for number in range(50):
        sender.send(message(number))
    assert [received(receiver).arbitration_id for _ in range(50)] == list(range(50))
    assert len(exact_bus.errors) == noisy


virtual_time = pytest.mark.virtual_time


@virtual_time
async def test_chosen_frames_are_disturbed(exact_bus: ExactBus) -> None:
    a, b = exact_bus.open(), exact_bus.open()
    exact_bus.disturb_next(2, identifier=7, is_extended_id=False, bit=20)
    exact_bus.disturb_next(sender=b, bit=30)
    for sender in (a, b):
        sender.send(message(6, is_extended_id=False))
        sender.send(message(7, is_extended_id=False))
        sender.send(message(7))
        await asyncio.sleep(0.01)
    found = [(each.frame.id, each.frame.extended, each.senders) for each in exact_bus.errors]
    assert found == [(7, False, ("node1",)), (7, False, ("node1",)), (6, False, ("node2",))]
    assert {each.error for each in exact_bus.errors} <= set(ErrorKind)
    assert len(exact_bus.frames) == 6


@virtual_time
async def test_power_and_wires_are_cut_and_come_back(exact_bus: ExactBus) -> None:
    a, b = exact_bus.open(), exact_bus.open(ignore_rx_error_frames=True)
    exact_bus.power_off(b)
    a.send(message(1))
    await asyncio.sleep(0.05)
    assert a.state is can.BusState.PASSIVE  # nobody acknowledges
    assert b.recv(0) is None
    exact_bus.power_on(b)
    await asyncio.sleep(0.01)
    found = b.recv(0)
    assert found is not None
    assert found.arbitration_id == 1

    exact_bus.cut_wire(a)
    a.send(message(2))
    await asyncio.sleep(0.05)
    assert b.recv(0) is None
    exact_bus.mend_wire(a)
    await asyncio.sleep(0.01)
    found = b.recv(0)
    assert found is not None
    assert found.arbitration_id == 2
    with pytest.raises(KeyError):
        exact_bus.power_off("nobody")


@virtual_time
async def test_a_short_circuit_stops_everything(exact_bus: ExactBus) -> None:
    sender, receiver = exact_bus.open(recovery=True), exact_bus.open(ignore_rx_error_frames=True)
    sender.send(message(3, bytes(8)))
    await asyncio.sleep(80e-6)  # in the middle of the frame
    exact_bus.short(0.1)
    await asyncio.sleep(0.09)
    assert receiver.recv(0) is None
    assert [node.state for node in (sender, receiver)] == [can.BusState.ERROR, can.BusState.PASSIVE]
    await asyncio.sleep(0.1)
    found = receiver.recv(0)
    assert found is not None
    assert found.arbitration_id == 3


@virtual_time
async def test_a_bus_of_the_loop_is_exact(exact_bus: ExactBus) -> None:
    exact_bus.bitrate = 500_000
    a, b = exact_bus.open(), exact_bus.open()
    loop = asyncio.get_running_loop()
    reader = can.AsyncBufferedReader()
    with can.Notifier(b, [reader], loop=loop):
        a.send(message(0x123, b"\x55" * 8, is_extended_id=False))
        found = await reader.get_message()
    (frame,) = exact_bus.frames
    assert frame.end == round(loop.time() * 1e9) == frame.bits * 2000
    assert found.data == b"\x55" * 8


@virtual_time
@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=8))
async def test_each_example_has_a_bus_of_its_own(exact_bus: ExactBus, data: bytes) -> None:
    a, b = exact_bus.open(), exact_bus.open()
    b.fileno()
    a.send(message(1, data))
    await asyncio.sleep(0.001)
    assert [each.frame.data for each in exact_bus.frames] == [data]


# In the projects of others

USE = """
import can

@pytest.fixture
def motor(exact_bus):
    return exact_bus.open("motor")
"""


def test_the_plugin_has_the_fixture(project: pytest.Pytester) -> None:
    tests = """
def test_real_time(exact_bus, motor):
    panel = exact_bus.open()
    motor.send(can.Message(arbitration_id=1))
    assert panel.recv(20).arbitration_id == 1

async def program():
    async with asyncio.timeout(1):
        await asyncio.sleep(0)

@pytest.mark.virtual_time
async def test_virtual_time(exact_bus):
    motor, panel = exact_bus.open(), exact_bus.open()
    motor.send(can.Message(arbitration_id=1))
    await asyncio.sleep(60)
    assert panel.recv(0).arbitration_id == 1
    assert asyncio.get_running_loop().time() == 60
"""
    assert outcomes(project, USE + tests) == {"passed": 2}


def test_nodes_are_shut_down_after_the_test(project: pytest.Pytester) -> None:
    tests = """
from r2p.sim.transport import running_buses
kept = []

def test_first(exact_bus):
    kept.append(exact_bus.open())
    assert running_buses()

def test_second():
    assert not running_buses()
    with pytest.raises(can.CanOperationError, match="closed"):
        kept[0].recv()
"""
    project.makepyfile("import asyncio, pytest" + USE + tests)
    project.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:randomly").assert_outcomes(passed=2)


def test_a_fixture_can_not_use_it_before_virtual_time_has_begun(project: pytest.Pytester) -> None:
    tests = """
@pytest.mark.virtual_time
async def test_too_early(motor):
    pass
"""
    project.makepyfile("import asyncio, pytest" + USE + tests)
    result = project.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:asyncio")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(
        ["*with virtual_time, exact_bus is a bus of the test's event loop: use it in the test*"]
    )


def test_without_python_can_it_says_what_to_install(project: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "can", None)
    monkeypatch.delitem(sys.modules, "r2p.testing.exact_bus")
    project.makepyfile("def test_bus(exact_bus):\n    pass\n")
    result = project.runpytest_inprocess("-p", "no:cacheprovider")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*the fixture exact_bus needs python-can: pip install 'r2p?can?'"])


def test_an_async_test_that_nothing_runs_is_an_error(project: pytest.Pytester) -> None:
    project.makepyfile("async def test_unmarked(exact_bus):\n    pass\n")
    result = project.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:asyncio", "-p", "no:anyio")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*mark it with @pytest.mark.virtual_time*"])
