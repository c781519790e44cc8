"""Logs of candump: a line of text for each frame, which can-utils, SavvyCAN and python-can read and write.

    (1700000000.123456) can0 123#0102 R              11 bits; R: received, T: sent by that computer, or neither
    (1700000000.123457) can0 1ABCDE00#R8             29 bits, and a remote frame that asks for 8 bytes
    (1700000000.123458) can0 20000008#0000040000000000   an error frame

Own code and not python-can's, which drops what an error frame reports, and how many bytes a remote frame asks for.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from r2p.codecs.can_bits import ERROR, FRAME_MAX, IDENTIFIER_MASK
from r2p.recording.convert.can_records import FrameRecords, FrameSink
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses
from r2p.recording.frames import STANDARD_MASK, RecordedFrame, bus_name
from r2p.units import SECOND

_MICROSECOND = 1000  # ns
_LINE = re.compile(
    r"\((\d{1,12})\.(\d{1,9})\)\s+(\S{1,64})\s+([0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:(R)([0-9A-F]?)|((?:[0-9A-F]{2}\.?){0,8}))(?:\s+([RT]))?\s*",
    re.ASCII | re.IGNORECASE,
)
_FD = re.compile(r"\(\d+\.\d+\)\s+\S+\s+[0-9A-F]+##", re.ASCII | re.IGNORECASE)
_STANDARD_DIGITS = 3
_LINE_MAX = 4096  # characters; what is longer is read as several lines that are not frames


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    """Iterate over the frames; a line that is not a frame is counted."""
    records = FrameRecords(options, losses)
    with path.open(encoding="ascii", errors="replace") as file:
        for line in iter(lambda: file.readline(_LINE_MAX), ""):
            frame = parse(line)
            if isinstance(frame, str):
                if frame:
                    losses[frame] += 1
            elif (record := records.record(frame)) is not None:
                yield record


def parse(line: str) -> RecordedFrame | str:
    """Return the frame in a line, or a description of another line; an empty text for an empty line."""
    match = _LINE.fullmatch(line.rstrip("\r\n"))
    if match is None:
        return "" if not line.strip() else "frames of CAN FD" if _FD.match(line) else "lines that are not frames"
    seconds, fraction, bus, digits, remote, length, data, direction = match.groups()
    identifier, extended = int(digits, 16), len(digits) > _STANDARD_DIGITS
    error = bool(extended and identifier & ERROR)
    if identifier > (IDENTIFIER_MASK | ERROR if extended else STANDARD_MASK):
        return "lines that are not frames"
    content = bytes.fromhex((data or "").replace(".", ""))
    return RecordedFrame(
        int(seconds) * SECOND + int(fraction.ljust(9, "0")),
        bus_name(bus),
        identifier & IDENTIFIER_MASK,
        content.ljust(FRAME_MAX, b"\0") if error else content,
        extended and not error,
        int(length or "0", 16) if remote else None,
        error,
        sent=(direction or "").upper() == "T",
    )


def text_of(frame: RecordedFrame) -> str:
    """Return the line of a frame; its time is cut to microseconds, as in candump."""
    seconds, rest = divmod(frame.time, SECOND)
    if frame.error:
        identifier = f"{frame.id | ERROR:08X}"
    else:
        identifier = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
    data = frame.data.hex().upper() if frame.remote is None else f"R{frame.remote:X}" if frame.remote else "R"
    direction = "T" if frame.sent else "R"
    return f"({seconds}.{rest // _MICROSECOND:06}) {frame.bus} {identifier}#{data} {direction}\n"


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> "CandumpSink":
    """Begin a log."""
    return CandumpSink(path, losses)


class CandumpSink(FrameSink):
    """Writes a log."""

    def __init__(self, path: Path, losses: Losses) -> None:
        """Begin the file. Raises OSError."""
        super().__init__(losses)
        self._file: TextIO = path.open("x", encoding="ascii", newline="\n")

    def write(self, frame: RecordedFrame) -> bool:
        if frame.time % _MICROSECOND:
            self.losses["times finer than a microsecond"] += 1
        self._file.write(text_of(frame))
        return True

    def finish(self) -> None:
        """The log is complete."""

    def close(self) -> None:
        self._file.close()
