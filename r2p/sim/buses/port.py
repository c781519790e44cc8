"""`rtcan:r2psim:NAME`: a bus of another process or thread, as the port of a module or of a `BusMonitor`.

Stamps are those of the bus, exact to the nanosecond, however late this process reads them.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
from typing import TYPE_CHECKING, Final

from r2p.clock import Backoff, clock_of, random_of
from r2p.codecs.can_bits import ERROR, LOCAL, Frame, OtherFrame
from r2p.errors import Error, TransportError
from r2p.sim.buses import attach_if_found, wire
from r2p.sim.buses.attachment import AttachmentOptions, BusFilter
from r2p.sim.buses.served import not_served
from r2p.sim.can import ControllerState
from r2p.transports.can.port import CanPortListener, FrameTap, InterfacePort, OpenInterface
from r2p.transports.can.rawsocket import encode_error
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.codecs.can_bits import WireFrame
    from r2p.protocols.can_orders import Mailbox
    from r2p.sim.buses.attachment import BusAttachment, BusFrame

_LATENCY: Final = 1_000_000  # ns until a frame starts: the loop that serves the bus may wake up once in a millisecond
_BATCH: Final = 64  # events that one turn of the event loop handles: other tasks wait for so long
_RETRY_MAX: Final = 0.5  # seconds between two attempts to connect
_FAST: Final = "only r2p bus can follow it"
_UNUSABLE: Final = (ControllerState.BUS_OFF, ControllerState.DOWN)


class ServedBusPort(InterfacePort["_ServedInterface"]):
    """A node of its own on the bus that another process serves under this name, or that this one has in real time."""

    transmit_latency = _LATENCY
    coarse = True

    def __init__(self, channel: str, bitrate: int) -> None:
        super().__init__(f"r2psim:{channel}")
        self._channel = channel
        self._bitrate = bitrate
        self._clock: Callable[[], int] = super().now

    def now(self) -> int:
        """The time on the bus, or the module's before the first connection."""
        return self._clock()

    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        clock = clock_of()
        if getattr(clock, "virtual", False) and not getattr(clock, "paced", False):
            raise TransportError(f"rtcan:{self.name} is a bus in real time: under virtual time use sim:{self._channel}")
        backoff = Backoff(random_of(), longest=_RETRY_MAX)
        attachment = await self._connect()
        if attachment is None:
            raise not_served(self._channel)
        self._clock = attachment.clock.now
        opened()
        while True:
            if attachment is None:
                listener.on_waiting(str(not_served(self._channel)))
            else:
                await self._serve(attachment, listener)
                backoff.reset()
            await asyncio.sleep(backoff.delay())
            attachment = await self._connect()

    async def _connect(self) -> BusAttachment | None:
        """Connect in a thread, as a server may hesitate, and a loop of this process. Raises TransportError."""
        options = AttachmentOptions(
            name="monitor" if self.listen_only else "port",
            bitrate=self._bitrate,
            listen_only=self.listen_only,
            own=True,
            errors=True,
        )
        with concurrent.futures.ThreadPoolExecutor(1, "r2psim") as thread:
            attachment = await asyncio.wrap_future(thread.submit(attach_if_found, self._channel, options))
        if attachment is not None and not self.listen_only and attachment.clock.speed != 1.0:
            attachment.close()
            raise TransportError(
                f"rtcan:{self.name} goes {attachment.clock.speed:g} times as fast as real time: {_FAST}"
            )
        return attachment

    async def _serve(self, attachment: BusAttachment, listener: CanPortListener) -> None:
        bus = _ServedInterface(attachment, listener, self.tap)
        bus.start()
        try:
            reason = await self._use(bus, listener)
        finally:
            bus.close()
        listener.on_down(reason)


class _ServedInterface(OpenInterface):
    """An attachment to the bus, while it works."""

    def __init__(self, attachment: BusAttachment, listener: CanPortListener, tap: FrameTap | None) -> None:
        super().__init__(listener, latency=_LATENCY, confirm_timeout=SECOND)
        self._attachment = attachment
        self._tap = tap
        self._lost = 0

    def start(self) -> None:
        self._descriptor = self._attachment.fileno()
        self._loop.add_reader(self._descriptor, self._read_batch)

    def close(self) -> None:
        self._loop.remove_reader(self._descriptor)
        self._attachment.close()
        self._timer.close()
        self._mailboxes.clear()

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        wanted = () if filters is None else [BusFilter(value, mask, extended=True) for value, mask in filters]
        try:
            self._attachment.set_filters(wanted)
        except Error as error:
            self._end(str(error))

    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        try:
            self._attachment.send(frame, 0)
        except TimeoutError:
            return False
        except Error as error:
            self._end(str(error))
            return False
        return True

    def _read_batch(self) -> None:
        events: list[BusFrame] = []
        try:
            while len(events) < _BATCH and (event := self._attachment.receive(0)) is not None:
                events.append(event)
        except Error as error:
            self._end(str(error))
        if self._tap is not None:
            self._hand_to_tap(self._tap, events)
        else:
            self._hand_out(events)
        self._arm()

    def _hand_out(self, events: list[BusFrame]) -> None:
        for event in events:
            try:
                self._handle(event)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next event follows
                self._listener.internal_error(error)
        while self._lost < self._attachment.lost:
            self._lost += 1
            self._listener.on_fault("receive queue full")

    def _handle(self, event: BusFrame) -> None:
        frame = event.frame
        if event.state is not None:
            if event.state in _UNUSABLE:
                self._end(event.state.value)
        elif event.error is not None:
            self._listener.on_fault(event.error.value)
        elif isinstance(frame, OtherFrame):
            if not event.own:
                self._listener.on_other_frame(frame, event.end)
        elif frame is not None and not event.own:
            self._listener.on_frame(frame, event.end)
        elif frame is not None:
            self._mailboxes.seen(frame.id, frame.data, event.end, self._clock.monotonic())

    def _hand_to_tap(self, tap: FrameTap, events: list[BusFrame]) -> None:
        frames = [_wire_frame(event) for event in events if event.state is None]
        if frames:
            tap.on_frames(frames, events[0].utc - events[0].end)
        if self._lost < self._attachment.lost:
            lost, self._lost = self._attachment.lost - self._lost, self._attachment.lost
            tap.on_lost(lost, "receive queue full")


def _wire_frame(event: BusFrame) -> WireFrame:
    if event.error is not None:
        identifier, data = encode_error(event.error.value)
        return identifier | ERROR, data, LOCAL * event.own, event.end
    assert event.frame is not None
    identifier, length, data = wire.parts(event.frame)
    return identifier, data or bytes(length), LOCAL * event.own, event.end
