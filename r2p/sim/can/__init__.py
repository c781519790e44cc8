"""A CAN bus in software, exact to the bit: arbitration, the length of frames, and errors.

    bus = CanBus(asyncio.get_running_loop(), seed=1)
    a = bus.attach(CanNode("A", one_shot=True, drift_ppm=30.0))
    b = bus.attach(CanNode("B", receive=Latency(5_000, 3_000)))
    b.on_receive = lambda frame, stamp: print(stamp, frame)
    a.request(Frame(0x19007F80, b"hello"))

All frames of CAN 2.0 share the bus: `Frame` is a data frame with a 29-bit identifier, as RTCAN sends, `OtherFrame` any
other kind. Controllers see error frames (`on_bus_error`); some only listen. Faults are deterministic: bit errors by
seed or to order (`CanBus.disturb_next`), a short circuit (`CanBus.short`), and of a node a cut wire, a power failure,
babbling, lost frames.

Under virtual time every event happens at its exact nanosecond; on an ordinary loop the bus is paced to real time:
events keep their exact instants on the bus, and run as soon as the loop gets to them.

Work is done per frame, not per bit: the winner of an arbitration is the lowest of a few integers, and the codec counts
(and caches) the length of its frame. The same seed gives the same run: each node has its own random numbers.

Read `records` first (settings, and what is recorded), then `bus` (arbitration and frames) with `error_frames` and
`participants`, `controller` (mailboxes, callbacks, error counters) and `timeline` (events and clocks).
"""

from r2p.sim.can.bus import CanBus
from r2p.sim.can.controller import CanController
from r2p.sim.can.records import (
    ArbitrationLoss,
    BusError,
    CanNode,
    ControllerState,
    Count,
    ErrorKind,
    FrameRecord,
    Latency,
    Statistics,
)
from r2p.sim.can.timeline import LocalAlarm, LocalClock, Timeline, TimelineTimer

__all__ = [
    "ArbitrationLoss",
    "BusError",
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
