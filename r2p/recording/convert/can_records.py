"""CAN frames as records of a conversion, for all formats that hold only frames."""

import abc

from r2p.codecs.can_bits import FRAME_MAX
from r2p.errors import DecodeError
from r2p.messages import Timestamp, layout
from r2p.msg import Header
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses, RecordSink
from r2p.recording.frames import BusInfo, CanFrame, RecordedFrame, bus_name, frame_of_message
from r2p.runtime.sample import Sample, Source
from r2p.units import SECOND

_TYPE = layout(CanFrame).name
_NAME_MAX = 64
_DETAILS = "r2p_msgs/FrameDetails"
_END = SECOND << 31  # the stamps of ROS end in 2038


class FrameRecords:
    """Makes records of the frames in a file of another program, as far as the options ask for them."""

    def __init__(self, options: ConversionOptions, losses: Losses) -> None:
        self.losses = losses
        self._options = options
        self._counts: dict[str, int] = {}

    def record(self, frame: RecordedFrame) -> ConvertedRecord | None:
        """Return the record of a frame; None for a frame outside of the options, or one that a bag can't hold."""
        bus = BusInfo(frame.bus)
        topic = bus.topic.removeprefix("/")
        if not 0 <= frame.time < _END:
            self.losses["frames with a time before 1970 or after 2038"] += 1
            return None
        if not (self._options.wants(topic) and self._options.covers(frame.time)):
            return None
        number = self._counts[topic] = self._counts.get(topic, 0) + 1
        sample = Sample(_message(frame).encode(), Source(), frame.time, sequence=number)
        return ConvertedRecord(topic, frame.time, sample, CanFrame, bus.metadata(sent=frame.sent))


def _message(frame: RecordedFrame) -> CanFrame:
    size = len(frame.data) if frame.remote is None else frame.remote
    return CanFrame(
        Header(stamp=Timestamp.from_ns(frame.time), frame_id=frame.bus),
        frame.id,
        frame.remote is not None,
        frame.extended,
        frame.error,
        size,
        frame.data.ljust(FRAME_MAX, b"\0"),
    )


class FrameSink(RecordSink):
    """Writes the frames of a recording, and counts everything else as lost."""

    def put(self, record: ConvertedRecord) -> bool:
        if record.type_name == _DETAILS:
            return self.lose("details of frames, such as lost arbitrations")
        if record.type_name != _TYPE:
            return self.lose(f"messages of {record.topic}, which are not CAN frames")
        metadata = record.metadata or {}
        name = bus_name(metadata.get("bus") or record.topic.removesuffix("/frames"))[:_NAME_MAX]
        try:
            frame = frame_of_message(CanFrame.decode(record.sample.data), name, sent=metadata.get("direction") == "tx")
        except DecodeError:
            return self.lose(f"messages of {record.topic} that are not CAN frames")
        return self.write(frame)

    @abc.abstractmethod
    def write(self, frame: RecordedFrame) -> bool:
        """Write a frame; return False, and count why, if it has no place here."""
