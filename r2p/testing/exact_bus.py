"""A CAN bus in software for tests of programs that use python-can: the fixture `exact_bus`."""

from __future__ import annotations

import asyncio
import concurrent.futures
import itertools
import os
from typing import TYPE_CHECKING, Any, Final, TypeVar

import can

from r2p.codecs.can_bits import EXTENDED
from r2p.errors import Error
from r2p.sim.buses import AttachmentOptions, BusAttachment
from r2p.sim.buses.attachment import BITRATE, BusFilter
from r2p.sim.buses.local import attach_to_thread
from r2p.sim.loop import VirtualLoop
from r2p.sim.transport import SimCan, can_bus, running_buses
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.sim.can import FrameRecord

T = TypeVar("T")

_ANSWER_S: Final = 5.0  # for the thread that runs the bus
_NO_FRAMES: Final = (BusFilter(1 << 30, 1 << 30),)  # more bits than an identifier has
_numbers: Final = itertools.count(1)


class ExactBus:
    """A CAN bus of one test, exact to the bit, for programs that use python-can: the fixture `exact_bus`.

    `open` returns a `can.Bus` on it; a program opens its own with `interface="r2psim", channel=exact_bus.channel`. All
    that happens on the wire is recorded, and faults of real buses happen on demand.

    In a test with `@pytest.mark.virtual_time` the bus has the virtual time of the test, so use it in the test only, not
    in fixtures. Otherwise it runs in real time, in a thread, and any thread may use it.
    """

    def __init__(self, *, virtual: bool = False) -> None:
        """`virtual`: the bus has the virtual time of the event loop that is going to run."""
        self._virtual = virtual
        self._channel = f"test-{os.getpid()}-{next(_numbers)}"
        self._settings: dict[str, Any] = {"bitrate": BITRATE, "noise": 0.0, "seed": 0}
        self._shared: SimCan | None = None
        self._holder: BusAttachment | None = None  # keeps a bus in a thread alive
        self._records: list[FrameRecord] = []
        self._nodes: dict[can.BusABC, str] = {}

    @property
    def channel(self) -> str:
        """The name of the bus, which no other test has, for `can.Bus(interface="r2psim", channel=...)`."""
        self._bus()
        return self._channel

    @property
    def bitrate(self) -> int:
        """Bit/s; set it before anything else is done with the bus. The default is 1 000 000."""
        return int(self._settings["bitrate"])

    @bitrate.setter
    def bitrate(self, bitrate: int) -> None:
        self._set_up("bitrate", bitrate)

    @property
    def seed(self) -> int:
        """The seed of the random numbers, 0 by default; set it before anything else is done with the bus."""
        return int(self._settings["seed"])

    @seed.setter
    def seed(self, seed: int) -> None:
        self._set_up("seed", seed)

    @property
    def noise(self) -> float:
        """The share of frames with a bit error, 0.0 to 1.0. Set it at any time."""
        return float(self._settings["noise"])

    @noise.setter
    def noise(self, noise: float) -> None:
        AttachmentOptions(noise=noise)  # raises MessageError if it is not a share
        self._settings["noise"] = noise
        if self._shared is not None:
            self._call(setattr, self._shared.bus, "noise", noise)

    def open(self, name: str | None = None, **options: Any) -> can.BusABC:
        """Return a new `can.Bus` on this bus, which is shut down after the test at the latest.

        `name` is its name in records and for `power_off`, by default node1, node2, and so on. The other options are
        those of `R2pSimBus`, such as `receive_own_messages`, `listen_only` and `recovery`.
        """
        name = name or f"node{len(self._nodes) + 1}"
        self._bus()
        node = can.Bus(interface="r2psim", channel=self._channel, name=name, served=False, **options)
        self._nodes[node] = name
        return node

    # What happened

    @property
    def records(self) -> list[FrameRecord]:
        """All frames and error frames of the bus so far: who sent them, from when until when, and the error if any."""
        return self._call(list, self._records)

    @property
    def frames(self) -> list[FrameRecord]:
        """The frames that were sent well so far: `frame.id`, `frame.data`, `senders`, `start` and `end` in ns."""
        return [each for each in self.records if each.error is None]

    @property
    def errors(self) -> list[FrameRecord]:
        """The attempts to send that ended with an error frame; `error` says which one."""
        return [each for each in self.records if each.error is not None]

    def load(self) -> float:
        """Return the share of the time that the bus was occupied so far."""
        return self._call(self._bus().bus.load)

    # Faults

    def disturb_next(
        self,
        count: int = 1,
        *,
        identifier: int | None = None,
        is_extended_id: bool = True,
        sender: str | can.BusABC | None = None,
        bit: int | None = None,
    ) -> None:
        """Destroy the next `count` frames, repetitions included, with a bit error.

        `identifier` and `sender` choose frames. `bit` is the one that is inverted, counted from 1 with stuff bits; None
        draws one for each frame.
        """
        if identifier is not None and is_extended_id:
            identifier |= EXTENDED
        by = None if sender is None else self._name_of(sender)
        self._call(lambda: self._bus().bus.disturb_next(bit, count, identifier=identifier, sender=by))

    def power_off(self, node: str | can.BusABC) -> None:
        """Cut the power of a node, also in the middle of a frame: it neither sends nor acknowledges.

        `node` is one that `open` has returned, or the `name` with which a program has opened it. Raises KeyError if
        there is none.
        """
        name = self._name_of(node)
        self._call(lambda: self._bus().port(name).power_off())

    def power_on(self, node: str | can.BusABC) -> None:
        """Restore the power of a node: its error counters are 0, and what waited in its queue is sent."""
        name = self._name_of(node)
        self._call(lambda: self._bus().port(name).power_on())

    def cut_wire(self, node: str | can.BusABC) -> None:
        """Cut the wire to a node, which can't know: nothing is acknowledged, so it tries again until `mend_wire`."""
        name = self._name_of(node)
        self._call(lambda: self._bus().port(name).controller.cut_wire())

    def mend_wire(self, node: str | can.BusABC) -> None:
        """Mend the wire to a node, which takes part again with its error counters as they are."""
        name = self._name_of(node)
        self._call(lambda: self._bus().port(name).controller.mend_wire())

    def short(self, seconds: float) -> None:
        """Short-circuit the bus for some seconds: who is sending goes to bus-off, the others become error passive."""
        self._call(lambda: self._bus().bus.short(round(seconds * SECOND)))

    def close(self) -> None:
        """Shut down all nodes that `open` has returned, and leave the bus."""
        self._shut_down()
        if self._holder is not None:
            self._holder.close()

    # The bus

    def _set_up(self, name: str, value: int) -> None:
        if self._shared is not None:
            raise Error(f"exact_bus runs already: set its {name} before anything else is done with it")
        settings = self._settings | {name: value}
        AttachmentOptions(**settings)  # raises MessageError if it is not valid
        self._settings = settings

    def _shut_down(self) -> None:
        for node in self._nodes:
            node.shutdown()
        self._nodes.clear()

    def _name_of(self, node: str | can.BusABC) -> str:
        return node if isinstance(node, str) else self._nodes[node]

    def _bus(self) -> SimCan:
        """Return the bus, which is made at first use."""
        if self._virtual:
            return self._bus_of_loop()
        if self._shared is None:
            nothing: dict[str, Any] = {"listen_only": True, "states": False, "filters": _NO_FRAMES}
            options = AttachmentOptions(name="exact_bus", **self._settings, **nothing)
            self._holder = attach_to_thread(self._channel, options)
            self._shared = next(shared for name, shared in running_buses() if name == self._channel)
            self._call(self._shared.bus.observers.append, self._records.append)
        return self._shared

    def _bus_of_loop(self) -> SimCan:
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            loop = None
        if not isinstance(loop, VirtualLoop):
            raise Error("with virtual_time, exact_bus is a bus of the test's event loop: use it in the test itself")
        if self._shared is None or self._shared.loop is not loop:  # a loop for each example of hypothesis
            self._shut_down()
            self._records = []
            self._shared = can_bus(self._channel, **self._settings)
            self._shared.bus.observers.append(self._records.append)
        return self._shared

    def _call(self, function: Callable[..., T], *args: Any) -> T:
        """Call this where the bus runs, between two of its events, and return its result."""
        shared = self._bus()
        if self._virtual:
            return function(*args)
        answer: concurrent.futures.Future[T] = concurrent.futures.Future()

        def call() -> None:
            try:
                shared.bus.timeline.catch_up()
                answer.set_result(function(*args))
            except BaseException as error:  # noqa: BLE001 - raised where it was asked for
                answer.set_exception(error)

        shared.loop.call_soon_threadsafe(call)
        return answer.result(_ANSWER_S)
