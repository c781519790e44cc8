"""`r2p bag frames`: the CAN frames of a recording, as the commands of `r2p bus` show those of a live bus."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2p.bus import FrameKind, SeenFrame
from r2p.tools.bag.files import File, opened
from r2p.tools.bag.times import End, Start, span
from r2p.tools.bus.slots import Svg, show
from r2p.tools.bus.traffic import Kinds, OnlyTopics, frame_line, frame_record, load_record, load_text, trouble
from r2p.tools.options import Count, Format, time_option
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.recording.frame_reader import BusReader
    from r2p.recording.frames import RecordedFrame

Window = tuple[int | None, int | None]


async def frames(
    file: File,
    *,
    bus: Annotated[
        str | None, typer.Option("--bus", metavar="NAME", help="This bus, where the recording has several.")
    ] = None,
    kind: Kinds = None,
    topic: OnlyTopics = None,
    load: Annotated[bool, typer.Option("--load", help="The load of the bus instead of its frames.")] = False,
    period: Annotated[float | None, time_option("--period", "With --load: in periods of this; default: 1s.")] = None,
    slots: Annotated[bool, typer.Option("--slots", help="The use of RTCAN's slots instead of the frames.")] = False,
    svg: Svg = None,
    start: Start = None,
    end: End = None,
    count: Count = None,
    format: Format = None,
) -> None:
    """Print the CAN frames of a recording.

    A line has time, slot, kind, topic, module, laxity, fragment and data, as in `r2p bus dump`; the time is in seconds
    from the start of the recording.
    """
    from r2p.recording.frame_reader import BusReader  # only here, as it takes a while

    _check(load=load, slots=slots, filtered=bool(kind or topic), svg=svg, period=period)
    output = Output(format)
    with opened(file) as bag:
        reader = BusReader(bag)
        name = reader.bus(bus).name
        window = span((bag.start, bag.end), start, end)
        for reason, number in reader.lost(name).items():
            notify(f"{number} frames of {name} are not in the recording: {reason}")
        if load:
            await _print_loads(reader, name, window, output, round((period or 1.0) * SECOND), count)
        elif slots:
            await _print_slots(reader, name, window, output, svg)
        else:
            shown = _FrameFilter(set(kind or FrameKind), set(topic or ()), keep_errors=not (kind or topic))
            await _print_frames(reader, name, window, output, shown, count)
    for channel, number in bag.undecodable.items():
        notify(f"{number} messages of {channel} are not CAN frames, and were left out")


def _check(*, load: bool, slots: bool, filtered: bool, svg: Path | None, period: float | None) -> None:
    if load and slots:
        raise UsageError("--load and --slots are two views: give one of them")
    if filtered and (load or slots):
        raise UsageError("--kind and --topic choose frames to print: not with --load or --slots")
    if svg is not None and not slots:
        raise UsageError("--svg draws the slots: give --slots as well")
    if period is not None and not load:
        raise UsageError("--period is that of --load: give --load as well")


class _FrameFilter:
    """What of the frames is printed."""

    def __init__(self, kinds: set[FrameKind], topics: set[str], *, keep_errors: bool) -> None:
        self.keep_errors = keep_errors
        self._kinds = kinds
        self._topics = topics

    def has(self, seen: SeenFrame) -> bool:
        return seen.kind in self._kinds and (not self._topics or seen.topic in self._topics)


async def _print_frames(
    reader: "BusReader", name: str, window: Window, output: Output, shown: _FrameFilter, count: int | None
) -> None:
    printed = 0
    for frame, seen in _described(reader, name, window):
        if seen is None:
            if not shown.keep_errors:
                continue
            await output.put(*_error(frame, reader.start))
        elif shown.has(seen):
            await output.put(frame_record(seen, reader.start), frame_line(seen, reader.start))
        else:
            continue
        printed += 1
        if printed == count:
            return


def _described(reader: "BusReader", name: str, window: Window) -> Iterator[tuple["RecordedFrame", SeenFrame | None]]:
    from r2p.recording.frame_reader import observe

    monitor = reader.monitor(name)
    for frame in reader.read(name, start=window[0], end=window[1]):
        yield frame, observe(monitor, frame)


def _error(frame: "RecordedFrame", since: int) -> tuple[dict[str, object], str]:
    """Return an error frame as a record, and as a line of text."""
    from r2p.recording.frame_reader import errors_in

    text = ", ".join(errors_in(frame))
    time = (frame.time - since) / SECOND
    record: dict[str, object] = {"time": round(time, 9), "id": f"0x{frame.id:08X}", "kind": "error"}
    return record | {"data": frame.data.hex(), "text": text}, f"{time:11.6f}    {'error':10} {text}"


async def _print_loads(
    reader: "BusReader", name: str, window: Window, output: Output, period: int, count: int | None
) -> None:
    loads = reader.loads(name, period, start=window[0], end=window[1])
    for number, (begin, report) in enumerate(loads, 1):
        time = (begin - reader.start) / SECOND
        await output.put({"time": round(time, 9), **load_record(report)}, f"{time:.3f} s: {load_text(report)}")
        if (warning := trouble(report)) is not None:
            notify(f"{time:.3f} s: {warning}")
        if number == count:
            return


async def _print_slots(reader: "BusReader", name: str, window: Window, output: Output, svg: Path | None) -> None:
    monitor = reader.watch(name, start=window[0], end=window[1])
    if not monitor.cycles:
        raise UsageError(f"{name} has no two sync frames in a row there: it has no RTCAN master, so it has no slots")
    await show(monitor.slots, monitor.directory.timing, monitor.cycles, output, svg)
