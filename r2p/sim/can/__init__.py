"""A CAN bus in software, exact to the bit: who wins arbitration, how long frames take, what errors do.

    bus = CanBus(asyncio.get_running_loop(), seed=1)
    a = bus.attach(CanNode("A", one_shot=True, drift_ppm=30.0))
    b = bus.attach(CanNode("B", receive=Latency(5_000, 3_000)))
    b.on_receive = lambda frame, stamp: print(stamp, frame)
    a.request(Frame(0x19007F80, b"hello"))

It needs no hardware. Under virtual time every event happens at its very nanosecond; on an ordinary loop the bus is
paced to real time: events keep their exact instants on the bus, and are carried out as soon as the loop gets to them.

Work is done for frames, not for bits: the winner of an arbitration is the lowest of a few integers, and the length of
its frame is counted (and cached) by the codec. One seed, one course of events: each node has its own random numbers.
"""

from r2p.sim.can.bus import CanBus
from r2p.sim.can.controller import CanController
from r2p.sim.can.node import CanNode, ControllerState, ErrorKind, FrameRecord, Latency, LocalAlarm, LocalClock
from r2p.sim.can.statistics import Count, Statistics
from r2p.sim.can.timeline import Timeline, TimelineTimer

__all__ = [
    "CanBus",
    "CanController",
    "CanNode",
    "ControllerState",
    "Count",
    "ErrorKind",
    "FrameRecord",
    "Latency",
    "LocalAlarm",
    "LocalClock",
    "Statistics",
    "Timeline",
    "TimelineTimer",
]
