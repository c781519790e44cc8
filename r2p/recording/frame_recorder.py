"""Records all frames of a CAN bus, whether RTCAN is spoken there or not. It only listens.

    async with FrameRecorder("rtcan:can0", disk.put) as recorder:
        await stop.wait()
    print(recorder.frames, recorder.lost)

A bus in Linux, or an adapter of python-can, is read beside the modules of this program; SocketCAN shows their frames
too. A simulated bus is observed from outside: with the exact bits, lost arbitrations, and frames that were destroyed.
"""

import asyncio
from collections import Counter
from collections.abc import Callable
from typing import Any, Self

from r2p.clock import clock_of
from r2p.codecs.can_bits import ERROR, Frame, OtherFrame, WireFrame, to_wire
from r2p.errors import TransportError
from r2p.protocols.can_orders import Mailbox, Outcome
from r2p.recording.entries import BagEntry, MessageEntry
from r2p.recording.frames import SENDERS_MAX, TEXT_MAX, BusInfo, FrameDetails, FrameEntry, bus_name
from r2p.sim.can import ArbitrationLoss, FrameRecord
from r2p.sim.transport import SimCan
from r2p.sim.transport import from_url as sim_from_url
from r2p.transports.can.port import InterfacePort
from r2p.transports.can.rawsocket import encode_error
from r2p.transports.rtcan.transport import RtcanOptions
from r2p.transports.rtcan.transport import from_url as rtcan_from_url
from r2p.transports.stats import LoggedCounter
from r2p.transports.url import parse
from r2p.units import SECOND

CAN_SCHEMES = ("rtcan:", "sim:")
"""How the URLs of CAN buses begin."""

_SHARED = ("socketcan", "socketcand", "udp_multicast", "virtual")  # interfaces that several programs can open

Put = Callable[[list[BagEntry]], object]
"""Gets what is to be written; it does not wait."""

_BATCH_S = 0.05  # seconds in which the frames of a simulated bus are collected
_BATCH = 512  # frames after which they are handed on at once


def is_shareable(via: str) -> bool:
    """Return whether a module of this program can use the bus of a URL while its frames are recorded.

    An adapter with a driver of its own, such as slcan, is opened once.
    """
    interface, colon, _ = parse(via).address.partition(":")
    return via.startswith("sim:") or not colon or interface in _SHARED


def frames_of(
    via: str | SimCan, *, name: str = "", report: Callable[[str], object] | None = None
) -> "Callable[[object, Callable[[BagEntry], object]], FrameRecorder]":
    """Return a part of a `Recorder` that records the frames of a bus beside the topics; arguments as those below.

    Recorder(module, "drive.mcap", parts=[Observations, frames_of("rtcan:can0")])
    """

    def begin(_module: object, add: Callable[[BagEntry], object]) -> FrameRecorder:
        return FrameRecorder(via, lambda entries: [add(each) for each in entries], name=name, report=report)

    return begin


class FrameRecorder:
    """Records the frames of one bus while its block runs.

    `via` is an rtcan: URL, of which only the interface and the bit rate matter, a sim: URL, or a `SimCan`, which needs
    a `name`. `put` gets entries for the file. `report` is called with a text when the interface goes up or down.
    """

    def __init__(
        self, via: str | SimCan, put: Put, *, name: str = "", report: Callable[[str], object] | None = None
    ) -> None:
        """Choose the bus. Raises TransportError for a URL that can't be that of a CAN bus."""
        self.frames = 0
        """The frames that were handed on."""
        self.lost: Counter[str] = Counter()
        """Frames that were on the bus and are not in the file, by reason; they are in the file as numbers."""
        self._put = put
        self._source: _ObservedBus | _RecordedInterface
        if isinstance(via, SimCan):
            self.bus = BusInfo(name or "sim", "sim:", SECOND // via.bus.bit)
            self._source = _ObservedBus(via, self)
            return
        url = parse(via)
        if f"{url.scheme}:" not in CAN_SCHEMES:
            raise TransportError(f"{via} is not a CAN bus: frames are those of rtcan: or sim:")
        link = f"{url.scheme}:{url.address}"
        if url.scheme == "sim":
            transport = sim_from_url(url)
            self.bus = _bus(name or bus_name(url.address), link, transport.options)
            self._source = _ObservedBus(transport.can_bus(), self)
        else:
            rtcan = rtcan_from_url(url)
            port = rtcan.make_port()
            assert isinstance(port, InterfacePort)
            self.bus = _bus(name or bus_name(url.address.removeprefix("socketcan:")), link, rtcan.options)
            self._source = _RecordedInterface(via, port, self, report)

    async def __aenter__(self) -> Self:
        """Begin to record. Raises TransportError for an interface that does not exist; waits for one that is down."""
        await self._source.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Hand on the frames that were on the bus until now, and close the interface."""
        await self._source.close()

    def add(self, frames: list[WireFrame], utc_offset: int) -> None:
        """Hand on frames. `utc_offset`: ns from their stamps to UTC."""
        if frames:
            self.frames += len(frames)
            self._put([FrameEntry(self.bus, frames, utc_offset)])

    def add_lost(self, count: int, reason: str) -> None:
        """Count frames that were not received, here and in the file."""
        self.lost[reason] += count
        self.add_event("lost", reason, count)

    def add_event(self, event: str, text: str, count: int = 0) -> None:
        """Hand on something that happened now."""
        now = clock_of().now()
        short = text.encode()[:TEXT_MAX].decode(errors="ignore")
        self.add_details([FrameDetails(event, start=now, end=now, count=count, text=short)])

    def add_details(self, details: list[FrameDetails]) -> None:
        """Hand on details; they are written under their end."""
        self._put([MessageEntry(self.bus.details, each, each.end) for each in details])


def _bus(name: str, link: str, options: RtcanOptions) -> BusInfo:
    timing = options.timing
    return BusInfo(name, link, options.bitrate, timing.slots, round(options.cycle * SECOND))


class _RecordedInterface:
    """An interface of this computer: a port, whose listener and tap this is."""

    def __init__(
        self, via: str, port: InterfacePort[Any], recorder: FrameRecorder, report: Callable[[str], object] | None
    ) -> None:
        self._via = via
        self._port: InterfacePort[Any] = port
        self._recorder = recorder
        self._report = report or (lambda _text: None)
        self._waits_for = ""
        self._running: asyncio.Task[None] | None = None
        self._errors = LoggedCounter(via, clock_of())

    async def open(self) -> None:
        self._port.tap = self
        self._port.listen_only = True
        self._port.set_filters(None)
        opened = asyncio.Event()
        self._running = asyncio.create_task(self._port.run(self, opened.set), name=f"record {self._via}")
        waiting = asyncio.create_task(opened.wait())
        try:
            await asyncio.wait([waiting, self._running], return_when=asyncio.FIRST_COMPLETED)
            if self._running.done():
                self._running.result()
            self._running.add_done_callback(self._ended)
        except BaseException:  # also when cancelled: `__aexit__` is not called then
            await self.close()
            raise
        finally:
            waiting.cancel()

    async def close(self) -> None:
        if self._running is not None:
            self._running.cancel()
            await asyncio.wait([self._running])

    def _ended(self, running: "asyncio.Task[None]") -> None:
        """Report that the interface has failed for good."""
        if not running.cancelled() and (error := running.exception()) is not None:
            self.on_down(f"{error}; its frames are recorded no more")

    # Called by the port (`FrameTap`, `CanPortListener`)

    def on_frames(self, frames: list[WireFrame], utc_offset: int) -> None:
        self._recorder.add(frames, utc_offset)

    def on_lost(self, count: int, reason: str) -> None:
        self._recorder.add_lost(count, reason)

    def on_frame(self, frame: Frame, stamp: int) -> None:
        pass  # all frames come in batches

    def on_other_frame(self, frame: OtherFrame, stamp: int) -> None:
        pass

    def on_confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        pass  # nothing is sent, so nothing is confirmed

    def on_up(self) -> None:
        self._waits_for = ""
        self._recorder.add_event("up", "")
        self._report(f"{self._via} is up")

    def on_down(self, reason: str) -> None:
        self._recorder.add_event("down", reason)
        self._report(f"{self._via} is down: {reason}")

    def on_waiting(self, reason: str) -> None:
        if reason != self._waits_for:  # each reason is reported once
            self._waits_for = reason
            self._recorder.add_event("waiting", reason)
            self._report(f"{self._via}: {reason}; trying again")

    def on_fault(self, kind: str) -> None:
        self._recorder.add_event("fault", kind)

    def internal_error(self, error: Exception) -> None:
        self._errors.internal_error(error)


class _ObservedBus:
    """An observer of a simulated bus. It is not a node on it, so it acknowledges no frames."""

    def __init__(self, can: SimCan, recorder: FrameRecorder) -> None:
        self._bus = can.bus
        self._can = can  # which lives as long as it is in use
        self._recorder = recorder
        self._frames: list[WireFrame] = []
        self._details: list[FrameDetails] = []
        self._timer: asyncio.TimerHandle | None = None

    async def open(self) -> None:
        self._bus.observers.append(self._on_frame)
        self._bus.loss_observers.append(self._on_loss)

    async def close(self) -> None:
        self._bus.observers.remove(self._on_frame)
        self._bus.loss_observers.remove(self._on_loss)
        self._hand_on()

    def _on_frame(self, record: FrameRecord) -> None:
        frame = record.frame
        if record.error is None:
            event, text = "frame", ""
            self._frames.append(to_wire(frame, 0, record.end))
        else:
            event, text = "error", record.error.value
            identifier, data = encode_error(text)
            self._frames.append((identifier | ERROR, data, 0, record.end))
        senders = record.senders[:SENDERS_MAX]
        self._note(FrameDetails(event, frame.id, record.start, record.end, record.bits, 0, senders, text))

    def _on_loss(self, loss: ArbitrationLoss) -> None:
        bits = (loss.end - loss.start) // self._bus.bit
        self._note(FrameDetails("arbitration lost", loss.frame.id, loss.start, loss.end, bits, 0, (loss.node,)))

    def _note(self, details: FrameDetails) -> None:
        self._details.append(details)
        if len(self._details) >= _BATCH:
            self._hand_on()
        elif self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(_BATCH_S, self._hand_on)

    def _hand_on(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        clock = self._bus.timeline.clock
        offset = clock.now() - clock.monotonic()
        frames, details, self._frames, self._details = self._frames, self._details, [], []
        self._recorder.add(frames, offset)
        self._recorder.add_details([_in_utc(each, offset) for each in details])


def _in_utc(details: FrameDetails, offset: int) -> FrameDetails:
    return FrameDetails(
        details.event,
        details.id,
        details.start + offset,
        details.end + offset,
        details.bits,
        details.count,
        details.senders,
        details.text,
    )
