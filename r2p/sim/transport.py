"""`sim:NAME`: modules of one event loop on a simulated CAN bus, with RTCAN as on a real one.

    async with r2p.Module("A", via="sim:lab"), r2p.Module("B", via="sim:lab,drift=30"):
        lab = r2p.sim.can_bus("lab")
        lab.bus.observers.append(print)          # every frame, at its true time
        lab.port("B").power_off()                # B loses power

Under virtual time everything is exact to the nanosecond, and the same seed gives the same run. On an ordinary loop the
bus is paced to real time: its events run a little late, with their true instants.

`can.Bus(interface="r2psim", channel="lab")` is a node on the same bus. If it was there first, outside of an event loop,
the bus is in a thread of its own, and modules connect to it through python-can.
"""

import asyncio
import os
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import msgspec

from r2p.clock import random_of
from r2p.codecs import rtcan
from r2p.codecs.can_bits import EXTENDED, REMOTE, AnyFrame
from r2p.errors import TransportError
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.sim.can import CanBus, CanController, CanNode, ControllerState, ErrorKind, Latency
from r2p.sim.can.interrupts import ignore
from r2p.sim.clocks import VirtualClock
from r2p.sim.loop import VirtualLoop
from r2p.transports.can.port import CanPort, CanPortListener, PortAlarm
from r2p.transports.can.pythoncan import PythonCanPort
from r2p.transports.link import Hub, Transport
from r2p.transports.rtcan.transport import OPTIONS, RtcanOptions, apply_options, run_link
from r2p.transports.url import Url, duration
from r2p.units import NEVER, SECOND

_NO_POWER = "no power"
_MAILBOXES = (Mailbox.HRT, *[Mailbox.SRT] * (rtcan.NRT - 1), Mailbox.NRT)  # by laxity
_SENT, _LOST, _LATE = Outcome.SENT, Outcome.LOST, Outcome.LATE  # Python 3.11 is slow to look up a member of an enum
DEFAULTS = RtcanOptions(priority=1, utc=0.0)
"""The options of `sim:` URLs: every module can be elected master, and knows UTC."""


class PluggedNode(ABC):
    """A node that is plugged into a `SimCan`, with its controller."""

    controller: CanController

    @abstractmethod
    def power_off(self) -> None:
        """Cut the node's power, also in the middle of a frame; its software notices that it can't send."""

    @abstractmethod
    def power_on(self) -> None:
        """Restore the node's power: it starts as new."""


class SimCan:
    """A simulated CAN bus for nodes of the running event loop; `bus` is the wire itself, with statistics and faults.

    `bitrate` in bit/s. `noise`: the share of frames with a bit error. `seed`: None takes it from the loop's random
    numbers.
    """

    def __init__(
        self, *, bitrate: int = 1_000_000, noise: float = 0.0, seed: int | None = None, hosted: bool = False
    ) -> None:
        loop = asyncio.get_running_loop()
        numbers = random_of(loop).getrandbits(32) if seed is None else seed
        self.bus = CanBus(loop, bitrate=bitrate, noise=noise, seed=numbers)
        self.loop = loop
        clock = self.bus.timeline.clock
        self._epoch = clock.now() - clock.monotonic()  # once: so differences of stamps are exact
        self.powered = True
        """True if modules that connect have power."""
        self.hosted = hosted
        """True if the bus has an event loop of its own, in a thread: programs use it by `r2p.sim.buses.attach`."""
        self._nodes: dict[str, PluggedNode] = {}
        self._unplugged: dict[str, CanController] = {}

    def transport(self, options: RtcanOptions = DEFAULTS, **node: Any) -> "SimTransport":
        """Return a transport on this bus for the `via=` of one module; `node` are fields of `CanNode`."""
        return SimTransport("", options, node, shared=self)

    @property
    def bitrate(self) -> int:
        """Bit/s."""
        return SECOND // self.bus.bit

    @property
    def names(self) -> list[str]:
        """The names of the nodes that are on the bus."""
        return list(self._nodes)

    def utc(self, instant: int) -> int:
        """Return an instant of the bus (ns) as ns since 1970."""
        clock = self.bus.timeline.clock
        return instant + (clock.epoch if isinstance(clock, VirtualClock) else self._epoch)

    def port(self, name: str) -> PluggedNode:
        """Return an open module's or program's node. Raises KeyError if it is not on this bus."""
        return self._nodes[name]

    def power_off(self) -> None:
        """Cut the power of all modules, also of those that connect later."""
        self.powered = False
        for port in list(self._nodes.values()):
            port.power_off()

    def power_on(self) -> None:
        """Restore the power of all modules."""
        self.powered = True
        for port in list(self._nodes.values()):
            port.power_on()

    def free_name(self, name: str) -> str:
        """Return this name, followed by a number if a node has it already."""
        number, free = 1, name
        while free in self._nodes:
            number += 1
            free = f"{name} {number}"
        return free

    def plug_in(self, plugged: PluggedNode, node: CanNode) -> CanController:
        """Connect a node. One that was connected before gets its controller back, with its clock and numbers."""
        name = node.name
        while name in self._nodes or (name in self._unplugged and self._unplugged[name].node != node):
            name += "'"
            node = msgspec.structs.replace(node, name=name)
        self._nodes[name] = plugged
        controller = self._unplugged.pop(name, None)
        if controller is None:
            return self.bus.attach(node)
        controller.power_on()
        return controller

    def remove(self, controller: CanController) -> None:
        """Disconnect a node for good: the next one of its name gets a controller of its own."""
        self.bus.detach(controller)
        del self._nodes[controller.name]

    def unplug(self, controller: CanController) -> None:
        """Disconnect the node of this controller, which has closed."""
        controller.power_off()
        controller.filters = ()
        del self._nodes[controller.name]
        self._unplugged[controller.name] = controller


class SimPort(CanPort, PluggedNode):
    """A simulated controller as a port. Its clock is the node's, with its offset and drift."""

    now: Callable[[], int]

    def __init__(self, shared: SimCan, node: CanNode) -> None:
        super().__init__(node.name)
        self.one_shot = node.one_shot
        self.transmit_latency = node.transmit.nominal
        self.receive_latency = node.receive.nominal
        self.controller = shared.plug_in(self, node)
        self._shared = shared
        self._timeline = shared.bus.timeline
        self._clock = self.controller.clock
        self.now = self._clock.monotonic if self._clock.virtual else self._present
        self._listener: CanPortListener | None = None
        self._up = False

    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        self._listener = listener
        controller = self.controller
        controller.on_receive = listener.on_frame
        controller.on_other = listener.on_other_frame
        controller.on_sent = self._sent
        controller.on_lost = self._lost
        controller.on_error = self._failed
        controller.on_late = self._late
        controller.on_state = self._state
        try:
            if self._shared.powered:
                self._goes_up()
            else:
                controller.power_off()
                listener.on_waiting(_NO_POWER)
            opened()
            await asyncio.get_running_loop().create_future()
        finally:
            self._up = False
            self._listener = None
            controller.on_receive = controller.on_other = ignore

    def transmit(self, order: Transmit) -> None:
        last = None if order.not_after == NEVER else order.not_after
        frame, mailbox = order.frame, order.mailbox
        if not self.controller.request(frame, mailbox, not_before=order.not_before, not_after=last):
            self._confirm(mailbox, _LATE, self.now())

    def withdraw(self, order: Withdraw) -> None:
        if self.controller.abort(order.mailbox):
            self._confirm(order.mailbox, _LATE, self.now())

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        self.controller.filters = [(0, 0)]
        if filters is not None:  # for data frames with 29 bits alone
            self.controller.filters = [(each | EXTENDED, mask | EXTENDED | REMOTE) for each, mask in filters]

    def monotonic(self, instant: int) -> int:
        return self._clock.true(instant)

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        return self.controller.alarm(callback)

    # Faults

    def power_off(self) -> None:
        self.controller.power_off()
        self._goes_down(_NO_POWER)

    def power_on(self) -> None:
        self.controller.power_on()

    # From the controller

    def _present(self) -> int:
        self._timeline.catch_up()
        return self._clock.monotonic()

    # `_sent` and `_lost` are called for each frame, and spare the call of `_confirm`.

    def _sent(self, frame: AnyFrame, stamp: int) -> None:
        if self._listener is not None and self._up:
            self._listener.on_confirmed(_MAILBOXES[rtcan.laxity_of(frame.id)], _SENT, stamp - self.receive_latency)

    def _lost(self, frame: AnyFrame, stamp: int) -> None:
        if self._listener is not None and self._up:
            self._listener.on_confirmed(_MAILBOXES[rtcan.laxity_of(frame.id)], _LOST, stamp)

    def _late(self, frame: AnyFrame, stamp: int) -> None:
        self._confirm(_MAILBOXES[rtcan.laxity_of(frame.id)], _LATE, stamp)

    def _failed(self, frame: AnyFrame, kind: ErrorKind, stamp: int) -> None:
        if self._listener is not None and self._up:
            self._listener.on_fault(kind.value)
        self._confirm(_MAILBOXES[rtcan.laxity_of(frame.id)], Outcome.ERROR, stamp)

    def _confirm(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        if self._listener is not None and self._up:
            self._listener.on_confirmed(mailbox, outcome, at)

    def _state(self, state: ControllerState, _stamp: int) -> None:
        if state is ControllerState.BUS_OFF:
            self._goes_down(state.value)
        elif state is ControllerState.ACTIVE:
            self._goes_up()
        elif self._listener is not None:
            self._listener.on_fault(state.value)

    def _goes_up(self) -> None:
        if self._listener is not None and not self._up:
            self._up = True
            self._listener.on_up()

    def _goes_down(self, reason: str) -> None:
        if self._listener is not None and self._up:
            self._up = False
            self._listener.on_down(reason)


class SimTransport(Transport):
    """The connection of one module to a simulated bus: to `shared`, or to the running loop's bus of that name.

    `node` are fields of `CanNode`; `bus` are options of `SimCan`, if this transport makes it.
    """

    def __init__(
        self,
        name: str,
        options: RtcanOptions = DEFAULTS,
        node: dict[str, Any] | None = None,
        *,
        shared: SimCan | None = None,
        **bus: Any,
    ) -> None:
        self._name = name
        self._options = options
        self._node = node or {}
        self._shared = shared
        self._bus = bus

    @property
    def options(self) -> RtcanOptions:
        """The options of the URL."""
        return self._options

    def can_bus(self) -> SimCan:
        """Return the bus, which is made if the running loop has none of that name."""
        return self._shared or can_bus(self._name, bitrate=self._options.bitrate, **self._bus)

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        options = self._options
        if self._shared is None and _hosted_bus(self._name) is not None:
            attached = PythonCanPort("r2psim", self._name, options.bitrate)
            await run_link(f"sim:{self._name}", hub, opened, attached, options)
            return
        shared = self.can_bus()
        if shared.bitrate != options.bitrate:
            raise TransportError(f"sim:{self._name} has {shared.bitrate} bit/s, not {options.bitrate}")
        node = CanNode(hub.space.module, **{"one_shot": True} | self._node)
        port = SimPort(shared, node)
        try:
            await run_link(f"sim:{self._name}", hub, opened, port, options)
        finally:
            shared.unplug(port.controller)


_Buses = weakref.WeakValueDictionary[str, SimCan]
_buses: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, _Buses] = weakref.WeakKeyDictionary()
_buses_lock = threading.Lock()


def can_bus(name: str, **options: Any) -> SimCan:
    """Return the running loop's simulated bus of that name, made at first use with these options of `SimCan`.

    It lives as long as a module is on it, or the program holds a reference. Raises TransportError if it has been made
    by `can.Bus` outside of this loop, in real time: then it is in a thread of its own.
    """
    if _hosted_bus(name) is not None:
        text = f"the bus {name} runs in a thread of its own, because can.Bus has made it outside of this event loop"
        raise TransportError(f"{text}: use it by via='sim:{name}' and can.Bus, or make it here first")
    with _buses_lock:
        buses = _buses.setdefault(asyncio.get_running_loop(), weakref.WeakValueDictionary())
        shared = buses.get(name)
        if shared is None:
            shared = buses[name] = SimCan(**options)
        return shared


def forget_bus(shared: SimCan) -> None:
    """Remove a bus from those that can be joined, before its event loop ends."""
    with _buses_lock:
        buses = _buses[shared.loop]
        for name in [name for name, each in buses.items() if each is shared]:
            del buses[name]


def _hosted_bus(name: str) -> SimCan | None:
    """Return the bus of this name that runs in a thread of its own, if it is not the running loop's thread."""
    loop = asyncio.get_running_loop()
    if not _in_real_time(loop):
        return None
    return next((bus for each, bus in running_buses() if each == name and bus.hosted and bus.loop is not loop), None)


def running_buses() -> list[tuple[str, SimCan]]:
    """Return the buses of all event loops of this process that run now in real time, or at a speed, with their names.

    A bus of another thread's loop must be used in that thread only.
    """
    with _buses_lock:
        found = [(name, shared) for buses in _buses.values() for name, shared in buses.items()]
    return [(name, shared) for name, shared in found if shared.loop.is_running() and _in_real_time(shared.loop)]


def _in_real_time(loop: asyncio.AbstractEventLoop) -> bool:
    return not isinstance(loop, VirtualLoop) or loop.clock.paced


def _after_fork() -> None:
    global _buses_lock
    _buses_lock = threading.Lock()  # another thread may have held it
    _buses.clear()  # their loops run in the other process


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def from_url(url: Url) -> SimTransport:
    """Return the transport of `sim:NAME`. Options are those of `rtcan:`, and these.

    For the node: `drift` (ppm) and `offset` of its clock; `latency` in both directions, and `jitter`, its spread;
    `loss`, the share of received frames that it loses; `one_shot=0` for a controller that sends again by itself. For
    the bus, if this URL opens it: `noise`, `seed`.
    """
    if not url.address:
        raise TransportError(f"{url}: give the bus a name, as in sim:lab")
    values = url.parsed(OPTIONS | _OPTIONS)
    known = {key: value for key, value in values.items() if key in OPTIONS}
    latency = Latency(values.get("latency", 0), values.get("jitter", 0))
    node = {"transmit": latency, "receive": latency}
    node |= {field: values[key] for key, field in _FIELDS.items() if key in values}
    options = apply_options(str(url), known, DEFAULTS)
    bus = {key: values[key] for key in ("noise", "seed") if key in values}
    return SimTransport(url.address, options, node, **bus)


def _nanoseconds(text: str) -> int:
    return round(duration(text) * SECOND)


def _share(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise ValueError("a share must be between 0 and 1")
    return value


def _flag(text: str) -> bool:
    if text not in ("0", "1"):
        raise ValueError("use 0 or 1")
    return text == "1"


_FIELDS = {"drift": "drift_ppm", "offset": "offset", "loss": "loss", "one_shot": "one_shot"}

_OPTIONS: dict[str, Callable[[str], Any]] = {
    "drift": float,
    "offset": _nanoseconds,
    "latency": _nanoseconds,
    "jitter": _nanoseconds,
    "loss": _share,
    "one_shot": _flag,
    "noise": _share,
    "seed": int,
}
