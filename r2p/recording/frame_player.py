"""Plays the CAN frames of a recording onto a bus, as they were, in their order and with their spacing.

    with r2p.Bag("drive.mcap") as bag:
        async with FramePlayer(bag, "rtcan:vcan0") as player:
            await player.run()

What speaks RTCAN on that bus would take the recorded syncs, announcements and messages for those of live modules. So a
bus where RTCAN is spoken is refused, unless the caller wants it `anyway`.
"""

import asyncio
from collections import Counter
from collections.abc import Iterator
from types import TracebackType
from typing import Final, Self

from r2p.bus import BusMonitor, FrameKind
from r2p.codecs.can_bits import AnyFrame, WireFrame, from_wire, other_frame_bits
from r2p.errors import TransportError
from r2p.recording.bag import Bag
from r2p.recording.frame_reader import BusReader
from r2p.recording.frames import RecordedFrame
from r2p.recording.pacing import PacedStream, Pacer
from r2p.sim.can import CanNode, ControllerState, ErrorKind
from r2p.sim.transport import SimCan, SimPort
from r2p.sim.transport import from_url as sim_from_url
from r2p.transports.can.sending import FrameSender, QueuedSender, open_sender
from r2p.transports.rtcan.transport import from_url as rtcan_from_url
from r2p.transports.url import parse
from r2p.units import MILLISECOND, SECOND

LISTEN: Final = 0.7
"""Seconds to listen for RTCAN before playing: firmware of 2014 announces itself every 0.5 s."""

_NODE: Final = "play"
_FRAME_BYTES: Final = 200  # of memory
_LEAD: Final = MILLISECOND  # ns: a simulated frame starts before the instant under which it was recorded, its end
_RTCAN: Final = (FrameKind.SYNC, FrameKind.MANAGEMENT)


class FramePlayer:
    """Plays the frames of one bus of a bag while its block runs.

    `via` is an rtcan: URL, a sim: URL, or a `SimCan`. `bus` is the name of the bus in the recording, if it has several.
    `start` and `end` are instants of the recording (UTC, ns). `anyway`: play where RTCAN is spoken, too.
    """

    def __init__(
        self,
        bag: Bag,
        via: str | SimCan,
        *,
        bus: str | None = None,
        start: int | None = None,
        end: int | None = None,
        anyway: bool = False,
    ) -> None:
        """Choose the bus.

        Raises BagError if the bag has no frames of it, and TransportError for a URL that has no CAN bus.
        """
        reader = BusReader(bag)
        self.bus = reader.bus(bus)
        """The bus of the recording that is played."""
        self.start = bag.start if start is None else start
        self._reader = reader
        self._end = end
        self._anyway = anyway
        self._simulated = via if isinstance(via, SimCan) else None
        self._via = "the simulated bus" if isinstance(via, SimCan) else via
        if self._simulated is None:
            url = parse(self._via)
            if url.scheme == "sim":
                self._simulated = sim_from_url(url).can_bus()
            elif url.scheme != "rtcan":
                raise TransportError(f"{via} is not a CAN bus: frames are played onto rtcan: or sim:")
        self._sender: FrameSender | None = None

    @property
    def sent(self) -> int:
        """The frames that were sent so far."""
        return 0 if self._sender is None else self._sender.sent

    @property
    def refused(self) -> Counter[str]:
        """The frames that were not sent, by reason."""
        return Counter() if self._sender is None else self._sender.refused

    async def __aenter__(self) -> Self:
        """Listen whether RTCAN is spoken on the bus, and open it to send.

        Raises TransportError if it is, or if the interface can't be used now.
        """
        if not self._anyway and (heard := await self._hear()):
            raise TransportError(
                f"{self._via} has {heard}: modules there would take recorded frames for live ones; "
                "play onto another bus, such as vcan0, or all the same with --anyway (in programs: anyway=True)"
            )
        self._sender = await self._open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait until the last frames are sent, and close the interface."""
        if self._sender is not None:
            await self._sender.aclose()

    async def run(self, pacer: Pacer | None = None, *, loop: bool = False) -> None:
        """Play all frames; with `loop` again and again. A `pacer` has the rate, and may be paused.

        Raises TransportError when the interface fails.
        """
        pacer = pacer or Pacer(asyncio.get_running_loop())
        while True:
            stream = PacedStream(pacer, self._play, lambda _: _FRAME_BYTES)
            await stream.open(self._frames())
            pacer.begin(self.start - _LEAD)
            await stream.run()
            if not loop:
                return

    def _frames(self) -> Iterator[tuple[int, RecordedFrame]]:
        """Yield the frames, each with the instant at which to send it (UTC, ns)."""
        bit = 0 if self._simulated is None else SECOND // self.bus.bitrate
        for frame in self._reader.read(self.bus.name, start=self.start, end=self._end):
            length = other_frame_bits(from_wire(frame.wire)) * bit if bit and not frame.error else 0
            yield frame.time - length, frame

    def _play(self, _time: int, frame: RecordedFrame) -> None:
        assert self._sender is not None
        self._sender.send(frame.wire)

    async def _open(self) -> FrameSender:
        if self._simulated is not None:
            return SimulatedSender(self._simulated)
        url = parse(self._via)
        interface, colon, channel = url.address.partition(":")
        options = rtcan_from_url(url).options
        return await open_sender(interface if colon else "socketcan", channel if colon else interface, options.bitrate)

    async def _hear(self) -> str:
        """Return a description of the RTCAN traffic on the bus; empty for a bus without RTCAN."""
        if self._simulated is None:
            async with BusMonitor(self._via) as monitor:
                return await _rtcan_on(monitor)
        port = SimPort(self._simulated, CanNode(_NODE))
        try:
            async with BusMonitor(port) as monitor:
                return await _rtcan_on(monitor)
        finally:
            self._simulated.unplug(port.controller)


async def _rtcan_on(monitor: BusMonitor) -> str:
    try:
        async with asyncio.timeout(LISTEN):
            async for seen in monitor:
                if seen.kind in _RTCAN:
                    return "a live RTCAN master" if seen.kind is FrameKind.SYNC else "live RTCAN modules"
    except TimeoutError:
        pass
    return ""


class SimulatedSender(QueuedSender[AnyFrame]):
    """Sends to a simulated bus, as one more node, one frame after the other."""

    def __init__(self, can: SimCan) -> None:
        super().__init__()
        self._can = can
        self._controller = controller = SimPort(can, CanNode(_NODE)).controller
        controller.filters = [(0, 0)]
        controller.on_sent = self._on_sent
        controller.on_error = self._on_error
        controller.on_state = self._on_state

    def send(self, frame: WireFrame) -> None:
        if self.accepts(frame, len(self._waiting)):
            self._waiting.append(from_wire(frame))
            self._empty.clear()
            self._request()

    def _request(self) -> None:
        if self._waiting:
            self._controller.request(self._waiting[0])  # without effect while one is on its way, or in bus-off
        else:
            self._empty.set()

    def _on_sent(self, _frame: AnyFrame, _stamp: int) -> None:
        self.sent += 1
        self._waiting.popleft()
        self._request()

    def _on_error(self, _frame: AnyFrame, _kind: ErrorKind, _stamp: int) -> None:
        self.refused["destroyed on the bus"] += 1
        self._waiting.popleft()
        self._request()

    def _on_state(self, _state: ControllerState, _stamp: int) -> None:
        self._request()

    async def aclose(self) -> None:
        try:
            await self._drain("no node acknowledged them")
        finally:
            self._can.unplug(self._controller)
