"""RTCAN: the engine alone, and the simulated bus against real time."""

import asyncio
import functools
import time
from collections.abc import Callable, Iterator

from benchmarks.table import Row, rate, typical
from benchmarks.thesis.network import Scenario, simulated
from r2p.codecs import rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.can_orders import Outcome, Transmit
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import EngineSettings, Profile
from r2p.sim import run
from r2p.sim.can import CanBus, CanController, CanNode

FRAMES = 100_000
GAP = 140_000  # ns between two frames of a busy bus
SECONDS = 2.0


def frames(size: int, messages: list[int]) -> list[Frame]:
    """Frames that carry one message of `size` bytes after the other, from several topics in turn."""
    payload = bytes(range(size))
    return [
        Frame(rtcan.encode_identifier(10, message, left), data)
        for message in messages
        for left, data in rtcan.fragments(payload)
    ]


def ready_engine(now: int = 0) -> tuple[Engine, int]:
    """An engine that may send, without a bus, and the instant."""
    engine = Engine(EngineSettings(number=1 << 40, id8=10, profile=Profile.RTCAN, listen=0))
    actions = list(engine.start(now))
    while not engine.ready:
        now = engine.next_deadline() or now
        actions += engine.poll(now)
        for action in actions:
            if isinstance(action, Transmit):
                actions += engine.confirm(now, action.mailbox, Outcome.SENT, now)
        actions.clear()
    return engine, now


def engine_rate(size: int) -> float:
    """Frames a second through `Engine.receive`, to messages of `size` bytes."""
    engine, now = ready_engine()
    topics = [rtcan.message_id(rtcan.FIRST_TOPIC + number, 20) for number in range(10)]
    for topic in topics:
        engine.subscribe(topic, size)
    batch = frames(size, topics)
    receive = engine.receive
    messages = 0
    began = time.perf_counter()
    for _ in range(FRAMES // len(batch)):
        for frame in batch:
            now += GAP
            messages += len(receive(now, frame, now))
    took = time.perf_counter() - began
    count = FRAMES // len(batch) * len(batch)
    assert messages == count // rtcan.fragment_count(size)
    return count / took


def cyphal_rate() -> float:
    """The same of pycyphal: 8-byte frames to transfers of one frame, through its parser and its reassembly."""
    from pycyphal.transport import Timestamp, TransferFrom
    from pycyphal.transport.can._frame import CyphalFrame
    from pycyphal.transport.can._identifier import CANID, MessageCANID
    from pycyphal.transport.can._session._transfer_reassembler import TransferReassembler
    from pycyphal.transport.can.media import DataFrame, FrameFormat

    identifier = 4 << 26 | 3 << 21 | 1000 << 8 | 20
    batch = [DataFrame(FrameFormat.EXTENDED, identifier, bytearray(range(7)) + bytes([0xE0 | n])) for n in range(32)]
    reassembler = TransferReassembler(20, 7)
    transfers = 0
    began = time.perf_counter()
    for number in range(FRAMES):
        parsed, can_id = CyphalFrame.parse(batch[number % 32]), CANID.parse(identifier)
        assert parsed is not None
        assert isinstance(can_id, MessageCANID)
        transfer = reassembler.process_frame(Timestamp.now(), can_id.priority, parsed, 2_000_000_000)
        transfers += isinstance(transfer, TransferFrom)
    took = time.perf_counter() - began
    assert transfers == FRAMES
    return FRAMES / took


def bus_speed() -> float:
    """How much faster than real time a bus is on which four nodes always want to send."""

    def busy(controller: CanController) -> None:
        frame = Frame(rtcan.encode_identifier(10, ord(controller.name)), bytes(8))
        controller.on_sent = lambda *_: controller.request(frame)
        controller.on_receive = lambda *_: None
        controller.request(frame)

    async def main() -> None:
        bus = CanBus(asyncio.get_running_loop())
        for name in "ABCD":
            busy(bus.attach(CanNode(name)))
        await asyncio.sleep(SECONDS)
        assert bus.load() > 0.99

    return SECONDS / spent(lambda: run(main))


def network_speed() -> float:
    """The same of the thesis's network: three engines and a listener, a bus that is never idle for long."""
    coming_up = spent(lambda: simulated(Scenario(duration=0.01)))
    return SECONDS / (spent(lambda: simulated(Scenario(duration=SECONDS))) - coming_up)


def spent(function: Callable[[], object]) -> float:
    """Seconds of CPU."""
    began = time.process_time()
    function()
    return time.process_time() - began


def rows() -> Iterator[Row]:
    cyphal = typical(3, cyphal_rate)
    for size, what in ((8, "of one frame"), (64, "of 8 frames")):
        ours = typical(5, functools.partial(engine_rate, size))
        yield Row(
            f"RTCAN engine, 8-byte frames to messages {what}",
            rate(ours),
            f"pycyphal's reassembly, one frame {rate(cyphal)}: {ours / cyphal:.1f}x",
            "100 k/s",
            ours >= 100e3,
        )
    bus = typical(3, bus_speed)
    yield Row("simulated bus, 4 busy nodes", f"{bus:.1f}x real time", "real time", "5x", bus >= 5)
    network = typical(3, network_speed)
    yield Row("the thesis's network, engines and all", f"{network:.1f}x real time", "real time", "8x", network >= 8)
