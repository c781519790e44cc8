"""`r2p bus load` and `dump`: what a bus carries, in sum and frame by frame; and how a command opens a bus."""

import contextlib
from collections.abc import AsyncIterator
from typing import Annotated, Any

import typer

from r2p.bus import BusLoad, BusMonitor, FrameKind, SeenFrame
from r2p.errors import TransportError
from r2p.tools.bus.serving import SERVED
from r2p.tools.options import Count, Format, Once, Timeout, valid_topic
from r2p.tools.output import Output, aligned, notify
from r2p.tools.session import Settings, UsageError, check_urls, patience
from r2p.units import SECOND

CROWDED = 0.8
"""Share of the free slots above which events wait long (thesis 4.4)."""

_PERIOD = 1.0  # s
_FULL = 1.01  # a full bus, with the rest of a frame that began before its second

Kinds = Annotated[
    list[FrameKind] | None, typer.Option("--kind", help="Only frames of this kind (repeatable).", show_default=False)
]
OnlyTopics = Annotated[
    list[str] | None,
    typer.Option("--topic", parser=valid_topic, metavar="TOPIC", help="Only frames of this topic (repeatable)."),
]


@contextlib.asynccontextmanager
async def listen(settings: Settings) -> AsyncIterator[BusMonitor]:
    """Open the one `rtcan:` URL of the settings for listening. Raises UsageError unless there is exactly one."""
    urls = [url for url in settings.via if url.startswith("rtcan:")]
    if len(urls) != 1:
        raise UsageError(f"give one CAN bus, as in --via rtcan:can0{_instead(urls or settings.via)}{_served()}")
    check_urls(urls, settings.via_source)
    async with BusMonitor(urls[0], on_status=notify) as bus:
        yield bus


def _instead(urls: list[str]) -> str:
    if any(url.startswith("sim:") for url in urls):
        return (
            "; sim: is a bus inside one program: r2p sim --bus NAME lets others join it, --bus-report reports its load"
        )
    if len(urls) == 1 and urls[0].startswith("r2psim:"):
        return f"; did you mean rtcan:{urls[0]}?"
    return f" (not {' and '.join(urls)})" if urls else ""


def _served() -> str:
    """Say which simulated buses this user's programs serve."""
    from r2p.sim.buses import rendezvous  # takes long to import

    try:
        urls = [SERVED + each.name for each in rendezvous.served_buses()]
    except TransportError:
        return ""
    return f"; programs serve {' and '.join(urls)}" if urls else ""


async def load(
    bus: BusMonitor, *, count: Count = None, once: Once = False, timeout: Timeout = None, format: Format = None
) -> None:
    """Print the load of a CAN bus once a second.

    It counts all bits, including stuff bits, by topic and module, and sends nothing.

    `free slots used` is the load of the unreserved slots: above 80 % events wait long. Frames that RTCAN does not use
    (11-bit identifiers, remote frames) are of kind `other`.
    """
    output, reports = Output(format), 0
    count = 1 if once else count
    async with output.while_read(), patience("nothing received on the bus", timeout) as received:
        async for report in bus.loads(_PERIOD):
            if report.tallies:
                received()
            await output.put(load_record(report), load_text(report))
            if (warning := trouble(report)) is not None:
                notify(warning)
            reports += 1
            if reports == count:
                return


def load_record(report: BusLoad) -> dict[str, Any]:
    """Return a report as a record: shares of the time, bit/s."""
    return {
        "load": round(report.total, 6),
        "reserved": round(report.reserved, 6),
        "free_used": round(report.free_used, 6),
        "nrt_gap": None if report.nrt_gap is None else round(report.nrt_gap / SECOND, 6),
        "faults": report.faults,
        "traffic": _rows(report),
    }


def load_text(report: BusLoad) -> str:
    """Return a report as text."""
    faults = "".join(f", {count} {kind}" for kind, count in report.faults.items())
    head = f"load {report.total:.1%}, reserved {report.reserved:.1%}, free slots used {report.free_used:.1%}{faults}"
    rows = _rows(report)
    columns = ["kind", "topic", "module", "frames_s", "kbit_s", "share"]
    return head + "\n" + (aligned(rows, columns) if rows else "")


def trouble(report: BusLoad) -> str | None:
    """Return a warning for the user, if the bus carries too much."""
    if report.total > _FULL:
        return (
            f"{report.total:.0%} is more than the bus can carry: either the bit rate is wrong (?bitrate=), or this "
            "program read the frames late and the driver does not stamp them"
        )
    if report.free_used <= CROWDED:
        return None
    gap = "none was seen" if report.nrt_gap is None else f"the longest pause was {report.nrt_gap / SECOND:.3f} s"
    return (
        f"{report.free_used:.0%} of the free slots are used: events wait long, non real-time traffic starves ({gap}); "
        "send less, or reserve slots for periodic messages (r2p bus admit)"
    )


def _rows(report: BusLoad) -> list[dict[str, Any]]:
    seconds = report.elapsed / SECOND
    return [
        {
            "kind": kind.value,
            "topic": topic,
            "module": module,
            "frames_s": round(tally.frames / seconds, 1),
            "kbit_s": round(tally.bits / seconds / 1000, 2),
            "share": round(report.share(tally.bits), 5),
        }
        for (topic, module, kind), tally in sorted(report.tallies.items(), key=lambda item: -item[1].bits)
    ]


async def dump(
    bus: BusMonitor,
    *,
    kind: Kinds = None,
    topic: OnlyTopics = None,
    count: Count = None,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Print the frames on a CAN bus, and send nothing.

    A line has time, slot, kind, topic, module, laxity, fragment and data.

    Topics and modules appear as numbers until they have announced their names.
    """
    kinds = set(kind or FrameKind)
    output, printed = Output(format), 0
    async with output.while_read(), patience("nothing received on the bus", timeout) as received:
        async for seen in bus:
            if seen.kind in kinds and (not topic or seen.topic in topic):
                received()
                await output.put(frame_record(seen, bus.since), frame_line(seen, bus.since))
                printed += 1
                if printed == count:
                    return


def frame_record(seen: SeenFrame, since: int) -> dict[str, object]:
    """Return a frame as a record; `time` is the end of the frame, in s since the command started to listen."""
    return {
        "time": round((seen.stamp - since) / SECOND, 9),
        "id": f"0x{seen.frame.id:08X}",
        "kind": seen.kind.value,
        "topic": seen.topic,
        "module": seen.module,
        "laxity": seen.laxity,
        "left": seen.left,
        "fragments": seen.fragments,
        "cycle": seen.cycle,
        "slot": seen.slot,
        "bits": seen.bits,
        "data": seen.frame.data.hex(),
        "text": seen.text,
    }


def frame_line(seen: SeenFrame, since: int) -> str:
    """Return a frame as a line of text."""
    slot = "" if seen.slot is None else f"{seen.slot:2}"
    if seen.fragments is not None:
        part = f"{seen.fragments - seen.left}/{seen.fragments}"
    else:
        part = f"-{seen.left}" if seen.left else ""
    return (
        f"{(seen.stamp - since) / SECOND:11.6f} {slot:>2} {seen.kind.value:10} {seen.topic:16} {seen.module:7} "
        f"{seen.laxity:2} {part:>5}  {seen.frame.data.hex():16}  {seen.text}"
    ).rstrip()
