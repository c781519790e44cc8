"""`r2p bus load`: how busy a bus is, with what, and whether that is too much; and how all commands open a bus."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from r2p.bus import BusLoad, BusMonitor
from r2p.tools.options import Count, Format, Once, Quiet, Timeout, Verbose, Via
from r2p.tools.output import Output, aligned, notify
from r2p.tools.session import UsageError, check_urls, execute, patience, settings
from r2p.units import SECOND

CROWDED = 0.8
"""Share of the free slots above which events wait long (thesis 4.4)."""

_PERIOD = 1.0  # s


@contextlib.asynccontextmanager
async def listen(via: list[str] | None) -> AsyncIterator[BusMonitor]:
    """Open the one `rtcan:` URL of `via` for listening. Raises UsageError unless there is exactly one."""
    given = settings(via, tool=True).via
    urls = [url for url in given if url.startswith("rtcan:")]
    if len(urls) != 1:
        raise UsageError(f"give one CAN bus, as in --via rtcan:can0 (not {' and '.join(urls or given) or 'none'})")
    check_urls(urls)
    async with BusMonitor(urls[0], on_status=notify) as bus:
        yield bus


def load(
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Print the load of a CAN bus once a second: all bits, including stuff bits, by topic and module. Sends nothing.

    `free slots used` is the load of the unreserved slots: above 80 % events wait long. Frames that RTCAN does not use
    (11-bit identifiers, remote frames) are of kind `other`.
    """
    reports = 1 if once else count

    async def main() -> None:
        output = Output(format)
        async with output.while_read(), listen(via) as bus, patience("the bus", timeout) as received:
            done = 0
            async for report in bus.loads(_PERIOD):
                if report.tallies:
                    received()
                await output.put(record(report), text(report))
                if (warning := trouble(report)) is not None:
                    notify(warning)
                done += 1
                if done == reports:
                    return

    execute(main, verbose=verbose, quiet=quiet)


def record(report: BusLoad) -> dict[str, Any]:
    """Return a report as a record: shares of the time, bit/s."""
    return {
        "load": round(report.total, 6),
        "reserved": round(report.reserved, 6),
        "free_used": round(report.free_used, 6),
        "nrt_gap": None if report.nrt_gap is None else round(report.nrt_gap / SECOND, 6),
        "faults": report.faults,
        "traffic": _rows(report),
    }


def text(report: BusLoad) -> str:
    """Return a report as text."""
    faults = "".join(f", {count} {kind}" for kind, count in report.faults.items())
    head = f"load {report.total:.1%}, reserved {report.reserved:.1%}, free slots used {report.free_used:.1%}{faults}"
    rows = _rows(report)
    columns = ["kind", "topic", "module", "frames_s", "kbit_s", "share"]
    return head + "\n" + (aligned(rows, columns) if rows else "")


def trouble(report: BusLoad) -> str | None:
    """Return a warning for the user, if the bus carries too much."""
    if report.total > 1.0:
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
