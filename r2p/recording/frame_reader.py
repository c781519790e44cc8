"""The CAN frames of a bag: what was on which bus, and what an RTCAN network made of it.

    frames = BusReader(bag)
    for frame in frames.read("can0"):
        print(frame.time, f"{frame.id:X}", frame.data.hex())
    monitor = frames.monitor("can0")
    for frame in frames.read("can0"):
        seen = observe(monitor, frame)                         # as `r2p bus dump` shows it

The frames of other programs' recordings are read as well: any channel of can_msgs/Frame is a bus.
"""

from collections import Counter
from collections.abc import Iterator

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import BagError, DecodeError
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.protocols.rtcan.monitor import BusLoad, Monitor, SeenFrame
from r2p.recording.bag import Bag
from r2p.recording.channels import BagChannel
from r2p.recording.format import CDR
from r2p.recording.frames import FRAME_TYPE, BusInfo, FrameDetails, RecordedFrame, bus_name, frame_of
from r2p.transports.can.rawsocket import decode_error

_SUFFIX = "/frames"


class BusReader:
    """Reads the frames of a bag. Those that can't be read are left out, and counted in `Bag.undecodable`."""

    def __init__(self, bag: Bag) -> None:
        self.buses: dict[str, BusInfo] = {}
        """The buses by name."""
        self.counts: Counter[str] = Counter()
        """The frames of each bus, also those that can't be read."""
        self.start = bag.start
        """The start of the recording (UTC, ns)."""
        self._bag = bag
        self._channels: dict[tuple[str, str, str], str] = {}  # the names of buses
        for channel in bag.channels:
            if channel.schema_name == FRAME_TYPE and channel.encoding == CDR:
                info = _info(channel)
                self.buses.setdefault(info.name, info)
                self.counts[info.name] += channel.count
                self._channels[_key(channel)] = info.name

    def bus(self, name: str | None = None) -> BusInfo:
        """Return the bus of this name; without one, the only bus. Raises BagError."""
        known = ", ".join(self.buses)
        if not known:
            raise BagError(f"{self._bag.paths[0]} has no CAN frames: r2p bag record --frames records them")
        if name is None and len(self.buses) > 1:
            raise BagError(f"{self._bag.paths[0]} has frames of several buses: choose one of {known}")
        found = self.buses.get(name or known)
        if found is None:
            raise BagError(f"{self._bag.paths[0]} has no frames of a bus {name!r}; it has those of {known}")
        return found

    def read(
        self, bus: str | None = None, *, start: int | None = None, end: int | None = None
    ) -> Iterator[RecordedFrame]:
        """Iterate over the frames of all buses or of one, in the order in which they were on the bus.

        `start` and `end` are instants (UTC, ns), `end` not included.
        """
        wanted = {key for key, name in self._channels.items() if bus is None or name == bus}
        for record in self._bag.raw(lambda each: _key(each) in wanted, start=start, end=end):
            channel = record.channel
            name, sent = self._channels[_key(channel)], channel.metadata.get("direction") == "tx"
            try:
                yield frame_of(record.data, name, sent=sent)
            except DecodeError:
                self._bag.undecodable[channel.name] += 1

    def details(self, bus: str) -> Iterator[FrameDetails]:
        """Iterate over what was recorded besides the frames of a bus."""
        for record in self._bag.messages(self.buses[bus].details, FrameDetails):
            yield record.message

    def lost(self, bus: str) -> Counter[str]:
        """Return the frames of a bus that were not recorded, by reason."""
        lost: Counter[str] = Counter()
        for each in self.details(bus):
            if each.event == "lost":
                lost[each.text] += each.count
        return lost

    def watch(self, bus: str, *, start: int | None = None, end: int | None = None) -> Monitor:
        """Return a monitor that has seen the frames of a bus: it has the use of the slots."""
        monitor = self.monitor(bus)
        for frame in self.read(bus, start=start, end=end):
            observe(monitor, frame)
        return monitor

    def loads(
        self, bus: str, period: int, *, start: int | None = None, end: int | None = None
    ) -> Iterator[tuple[int, BusLoad]]:
        """Iterate over the load of a bus in periods of so many ns, each with its start (UTC, ns).

        Periods without a frame are left out.
        """
        monitor = self.monitor(bus)
        begin: int | None = None
        last = 0
        for frame in self.read(bus, start=start, end=end):
            if begin is None:
                begin = frame.time
                monitor.reset(begin)
            elif frame.time >= begin + period:
                yield begin, monitor.load(begin + period)
                begin += (frame.time - begin) // period * period
                monitor.reset(begin)
            observe(monitor, frame)
            last = frame.time
        if begin is not None and last > begin:
            yield begin, monitor.load(last)

    def monitor(self, bus: str) -> Monitor:
        """Return a monitor that has seen no frame, and yet knows the names and the timing in the whole recording."""
        before = Monitor(_timing(self.buses[bus]))
        for frame in self.read(bus):
            if frame.extended and rtcan.high_byte(rtcan.message_of(frame.id)) <= rtcan.MANAGEMENT:
                observe(before, frame)
        learnt = before.directory
        monitor = Monitor(learnt.timing)
        monitor.directory.timing_known = learnt.timing_known
        monitor.directory.modules.update(learnt.modules)
        monitor.directory.topics.update(learnt.topics)
        monitor.directory.sizes.update(learnt.sizes)
        return monitor


def observe(monitor: Monitor, frame: RecordedFrame) -> SeenFrame | None:
    """Pass a frame to a monitor, and return its description; None for an error frame, which the monitor counts."""
    if frame.error:
        for kind in errors_in(frame):
            monitor.fault(kind)
        return None
    if frame.extended and frame.remote is None:
        return monitor.frame(Frame(frame.id, frame.data), frame.time)
    return monitor.other(OtherFrame(frame.id, frame.data, frame.extended, frame.remote), frame.time)


def errors_in(frame: RecordedFrame) -> tuple[str, ...]:
    """Return the kinds of errors that an error frame reports."""
    return decode_error(frame.id, frame.data).kinds


def _info(channel: BagChannel) -> BusInfo:
    try:
        info = BusInfo.from_metadata(channel.metadata)
    except DecodeError:
        info = None
    return info or BusInfo(bus_name(channel.name.removesuffix(_SUFFIX)))


def _key(channel: BagChannel) -> tuple[str, str, str]:
    return channel.name, channel.metadata.get("bus", ""), channel.metadata.get("direction", "")


def _timing(bus: BusInfo) -> Timing:
    try:
        return timing(bus.slots, bus.cycle, bus.bitrate)
    except ValueError:  # no frame fits into such slots
        usual = BusInfo(bus.name)
        return msgspec.structs.replace(timing(usual.slots, usual.cycle, usual.bitrate), bit=_bit(bus))


def _bit(bus: BusInfo) -> int:
    return max(1, round(1e9 / bus.bitrate))
