"""Programs of higher protocols on the exact bus, unchanged: canopen, can-isotp, udsoncan, cantools."""

import asyncio
import itertools
import queue
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import can
import pytest

from r2p.clock import clock_of
from r2p.testing.exact_bus import ExactBus
from r2p.units import SECOND

canopen = pytest.importorskip("canopen")
cantools = pytest.importorskip("cantools")
isotp = pytest.importorskip("isotp")
udsoncan = pytest.importorskip("udsoncan")

SOON = 20.0  # seconds: for what happens at once, unless the computer is busy
TURN = 0.02  # seconds that stopping a thread may take
NODE = 5


# CANopen

SPEED, HEARTBEAT = 0x2001, 0x1017


def object_dictionary() -> Any:
    """A node with a name, a speed that is mapped into its first TPDO and RPDO, and a heartbeat."""
    kinds = canopen.objectdictionary
    objects = kinds.ObjectDictionary()

    def variable(name: str, index: int, sub: int, kind: int, value: Any, parent: Any = None) -> None:
        found = kinds.ODVariable(name, index, sub)
        found.data_type, found.default, found.pdo_mappable = kind, value, True
        if parent is None:
            objects.add_object(found)
        else:
            parent.add_member(found)

    variable("Device type", 0x1000, 0, kinds.UNSIGNED32, 0x191)
    variable("Error register", 0x1001, 0, kinds.UNSIGNED8, 0)
    variable("Heartbeat", HEARTBEAT, 0, kinds.UNSIGNED16, 0)
    variable("Name", 0x2000, 0, kinds.VISIBLE_STRING, "")
    variable("Speed", SPEED, 0, kinds.INTEGER16, 0)
    for communication, identifier in ((0x1400, 0x200), (0x1800, 0x180)):
        record = kinds.ODRecord(f"{communication:x}", communication)
        variable("Highest sub-index", communication, 0, kinds.UNSIGNED8, 2, record)
        variable("COB-ID", communication, 1, kinds.UNSIGNED32, identifier + NODE, record)
        variable("Type", communication, 2, kinds.UNSIGNED8, 255, record)
        mapping = kinds.ODArray(f"{communication + 0x200:x}", communication + 0x200)
        variable("Number", communication + 0x200, 0, kinds.UNSIGNED8, 1, mapping)
        variable("First", communication + 0x200, 1, kinds.UNSIGNED32, SPEED << 16 | 16, mapping)
        objects.add_object(record)
        objects.add_object(mapping)
    return objects


@pytest.fixture
def nodes(exact_bus: ExactBus, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, Any]]:
    """The master's view of a node, and the node."""
    monkeypatch.setattr(canopen.Network, "NOTIFIER_CYCLE", TURN)
    monkeypatch.setattr(canopen.sdo.SdoClient, "RESPONSE_TIMEOUT", SOON)
    with canopen.Network() as master, canopen.Network() as device:
        for network in (master, device):
            network.connect(interface="r2psim", channel=exact_bus.channel)
        local = device.create_node(NODE, object_dictionary())
        yield master.add_node(NODE, object_dictionary()), local


def test_canopen_uploads_and_downloads(nodes: tuple[Any, Any]) -> None:
    remote, local = nodes
    remote.sdo["Speed"].raw = -7
    assert local.sdo["Speed"].raw == remote.sdo["Speed"].raw == -7
    remote.sdo["Name"].raw = "a name of more than one segment"
    assert local.sdo["Name"].raw == remote.sdo["Name"].raw == "a name of more than one segment"
    with pytest.raises(canopen.SdoAbortedError, match="does not exist"):
        remote.sdo.upload(0x3000, 0)


def test_canopen_has_its_heartbeat_its_states_and_emergencies(nodes: tuple[Any, Any]) -> None:
    remote, local = nodes
    emergencies: queue.Queue[Any] = queue.Queue()
    remote.emcy.add_callback(emergencies.put)
    remote.nmt.state = "OPERATIONAL"
    remote.sdo["Heartbeat"].raw = 10
    assert remote.nmt.wait_for_heartbeat(SOON) == local.nmt.state == "OPERATIONAL"
    local.emcy.send(0x2310, 1, b"hot")
    found = emergencies.get(timeout=SOON)
    assert (found.code, found.register, bytes(found.data[:3])) == (0x2310, 1, b"hot")


def test_canopen_exchanges_process_data(nodes: tuple[Any, Any]) -> None:
    remote, local = nodes
    remote.nmt.state = "OPERATIONAL"
    speeds: queue.Queue[int] = queue.Queue()
    for node in nodes:
        node.tpdo.read()
        node.rpdo.read()
    remote.tpdo[1].add_callback(lambda mapped: speeds.put(mapped["Speed"].raw))
    local.tpdo[1]["Speed"].raw = 1234
    local.tpdo[1].transmit()
    assert speeds.get(timeout=SOON) == 1234
    local.rpdo[1].add_callback(lambda mapped: speeds.put(mapped["Speed"].raw))
    remote.rpdo[1]["Speed"].raw = -1234
    remote.rpdo[1].transmit()
    assert speeds.get(timeout=SOON) == -1234


def test_canopen_does_not_notice_a_noisy_bus(nodes: tuple[Any, Any], exact_bus: ExactBus) -> None:
    """Its requests have time-outs and are not repeated: the controllers repeat the frames."""
    remote, local = nodes
    exact_bus.noise = 0.2
    remote.sdo["Name"].raw = "noise " * 20
    assert local.sdo["Name"].raw == remote.sdo["Name"].raw == "noise " * 20
    assert exact_bus.errors


@pytest.mark.virtual_time
async def test_canopen_has_an_hour_of_heartbeats_under_virtual_time(exact_bus: ExactBus) -> None:
    loop = asyncio.get_running_loop()
    with canopen.Network(exact_bus.open()) as master, canopen.Network(exact_bus.open()) as device:
        for network in (master, device):
            network.notifier = can.Notifier(network.bus, network.listeners, loop=loop)
        remote, local = master.add_node(NODE, object_dictionary()), device.create_node(NODE, object_dictionary())
        stamps: list[float] = []
        remote.nmt.add_heartbeat_callback(lambda _state: stamps.append(remote.nmt.timestamp))
        local.nmt.start_heartbeat(1000)
        await asyncio.sleep(3600.5)
        local.nmt.stop_heartbeat()
    assert len(stamps) == 3601
    assert [later - earlier for earlier, later in itertools.pairwise(stamps)] == pytest.approx([1.0] * 3600, abs=1e-6)


# ISO-TP and UDS

ISOTP = {"blocksize": 4, "stmin": 0, "tx_padding": 0xAA}


def address(tx: int, rx: int) -> Any:
    return isotp.Address(isotp.AddressingMode.Normal_11bits, txid=tx, rxid=rx)


@pytest.fixture
def stacks(exact_bus: ExactBus) -> Iterator[tuple[Any, Any]]:
    """The tester's and the control unit's transport layer."""
    timeouts = dict.fromkeys(("rx_flowcontrol_timeout", "rx_consecutive_frame_timeout"), 20000)
    both = [
        isotp.CanStack(exact_bus.open(), address=address(*identifiers), params=ISOTP | timeouts, read_timeout=TURN)
        for identifiers in ((0x7E0, 0x7E8), (0x7E8, 0x7E0))
    ]
    yield both[0], both[1]
    for each in both:
        each.stop()


def test_isotp_transfers_long_messages_with_flow_control(stacks: tuple[Any, Any], exact_bus: ExactBus) -> None:
    for each in stacks:
        each.start()
    for sender, receiver in (stacks, stacks[::-1]):
        data = bytes(number % 251 for number in range(300))
        sender.send(data)
        assert receiver.recv(block=True, timeout=SOON) == data
    kinds = [each.frame.data[0] >> 4 for each in exact_bus.frames]
    assert kinds.count(1) == 2  # first frames
    assert kinds.count(2) == 2 * 42  # consecutive frames
    assert kinds.count(3) == 2 * 11  # flow control, after the first one and after each block of four


def test_isotp_transfers_on_a_noisy_bus(stacks: tuple[Any, Any], exact_bus: ExactBus) -> None:
    exact_bus.noise = 0.2
    tester, unit = stacks
    for each in stacks:
        each.start()
    tester.send(bytes(500))
    assert unit.recv(block=True, timeout=SOON) == bytes(500)
    assert exact_bus.errors


@pytest.mark.virtual_time
async def test_isotp_transfers_under_virtual_time(exact_bus: ExactBus) -> None:
    """Its way without threads: `process` is called again and again."""
    stacks = [
        isotp.CanStack(exact_bus.open(), address=address(*identifiers), params=ISOTP, read_timeout=0)
        for identifiers in ((0x7E0, 0x7E8), (0x7E8, 0x7E0))
    ]
    tester, unit = stacks
    tester.send(bytes(range(200)))
    while not unit.available():
        for each in stacks:
            each.process(rx_timeout=0)
        await asyncio.sleep(0.001)
    assert unit.recv() == bytes(range(200))
    ends = [each.end for each in exact_bus.frames]
    assert len(ends) == 1 + 28 + 7  # with flow control, after the first frame and after each four but the last
    assert ends[-1] <= clock_of().monotonic() <= ends[-1] + 2 * SECOND // 1000


class HexCodec(udsoncan.DidCodec):  # type: ignore[misc, name-defined]
    def encode(self, *values: Any) -> bytes:
        return bytes.fromhex(values[0])

    def decode(self, payload: bytes) -> str:
        return payload.hex()

    def __len__(self) -> int:
        return 4


def test_uds_reads_data_and_has_negative_responses(stacks: tuple[Any, Any]) -> None:
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection

    tester, unit = stacks
    unit.start()
    answers = {
        bytes.fromhex("1003"): ["5003003201f4"],  # extended session
        bytes.fromhex("22f190"): ["7f2278", "62f190cafe0123"],  # the answer takes longer; then the data
        bytes.fromhex("221234"): ["7f2231"],  # request out of range
    }

    def serve() -> None:
        for _ in answers:
            for answer in answers[bytes(unit.recv(block=True, timeout=SOON))]:
                unit.send(bytes.fromhex(answer))

    settings: Any = {
        "data_identifiers": {0xF190: HexCodec, 0x1234: HexCodec},
        "request_timeout": SOON,
        "p2_timeout": SOON,
        "p2_star_timeout": SOON,
        "use_server_timing": False,
    }
    with ThreadPoolExecutor(1) as thread, Client(PythonIsoTpConnection(tester), config=settings) as client:
        control_unit = thread.submit(serve)
        session = udsoncan.services.DiagnosticSessionControl.Session.extendedDiagnosticSession
        assert client.change_session(session).service_data.session_echo == session
        assert client.read_data_by_identifier(0xF190).service_data.values[0xF190] == "cafe0123"
        with pytest.raises(udsoncan.exceptions.NegativeResponseException, match="RequestOutOfRange"):
            client.read_data_by_identifier(0x1234)
        control_unit.result(SOON)


# DBC files

DBC = """
VERSION ""
NS_ :
BS_:
BU_: Motor Panel
BO_ 256 Drive: 3 Motor
 SG_ Speed : 0|16@1- (0.5,0) [-1000|1000] "rpm" Panel
 SG_ Hot : 16|1@1+ (1,0) [0|1] "" Panel
BO_ 2147488000 Setpoint: 2 Panel
 SG_ Target : 0|16@1- (0.5,0) [-1000|1000] "rpm" Motor
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 10;
"""


def test_cantools_encodes_and_decodes(exact_bus: ExactBus) -> None:
    database = cantools.database.load_string(DBC, "dbc")
    sender, receiver = exact_bus.open(), exact_bus.open()
    for name, signals in (("Drive", {"Speed": -120.5, "Hot": 1}), ("Setpoint", {"Target": 300.0})):
        kind = database.get_message_by_name(name)
        data = kind.encode(signals)
        sender.send(can.Message(arbitration_id=kind.frame_id, is_extended_id=kind.is_extended_frame, data=data))
        found = receiver.recv(SOON)
        assert found is not None
        assert database.decode_message(found.arbitration_id, found.data) == signals


def test_testers_of_cantools_play_the_nodes(exact_bus: ExactBus, monkeypatch: pytest.MonkeyPatch) -> None:
    make, notifiers = can.Notifier, []

    def notifier(bus: can.BusABC, listeners: list[Any]) -> can.Notifier:  # testers do not stop theirs
        notifiers.append(make(bus, listeners, TURN))
        return notifiers[-1]

    monkeypatch.setattr(can, "Notifier", notifier)
    database = cantools.database.load_string(DBC, "dbc")
    motor, panel = testers = [  # each plays all nodes but the one that it tests
        cantools.tester.Tester(tested, database, exact_bus.open()) for tested in ("Panel", "Motor")
    ]
    for each in testers:
        each.start()
    try:
        motor.messages["Drive"].update({"Speed": 250.0, "Hot": 0})  # sent every 10 ms
        assert panel.expect("Drive", {"Speed": 250.0}, timeout=SOON) is not None
        panel.send("Setpoint", {"Target": -3.5})
        assert motor.expect("Setpoint", timeout=SOON) == {"Target": -3.5}
    finally:
        for each in testers:
            each.stop()
        for every in notifiers:
            every.stop()
