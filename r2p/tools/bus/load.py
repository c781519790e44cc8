"""`r2p bus load`: how full a bus is, with what, and whether that goes well."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from r2p.bus import BusLoad, BusMonitor
from r2p.tools.output import Output, aligned
from r2p.tools.session import Format, Quiet, Timeout, Usage, Verbose, Via, check_urls, execute, settings
from r2p.tools.terminal import say
from r2p.tools.topic.watching import Count, Once, patience

CROWDED = 0.8
"""Share of the free slots above which events begin to wait long (thesis 4.4)."""

_PERIOD = 1.0  # s


def load(
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Print the true load of a CAN bus once a second: all bits, stuffed ones included, by topic and module.

    `free used` is the load of what nobody reserved: above 80 % events wait long. Frames that are none of RTCAN (11-bit
    identifiers, remote frames) are of kind `other`. Sends nothing.
    """
    reports = 1 if once else count

    async def main() -> None:
        output = Output(format)
        async with output.while_read(), listen(via) as bus, patience("the bus", timeout) as heard:
            done = 0
            async for report in bus.loads(_PERIOD):
                if report.tallies:
                    heard()
                await output.put(record(report), text(report))
                if (warning := trouble(report)) is not None:
                    say(warning)
                done += 1
                if done == reports:
                    return

    execute(main, verbose=verbose, quiet=quiet)


def record(report: BusLoad) -> dict[str, Any]:
    """A report for programs; shares of the time, bit/s."""
    return {
        "load": round(report.total, 6),
        "reserved": round(report.reserved, 6),
        "free_used": round(report.free_used, 6),
        "nrt_gap": None if report.nrt_gap is None else round(report.nrt_gap / SECOND, 6),
        "faults": report.faults,
        "traffic": _rows(report),
    }


def text(report: BusLoad) -> str:
    """A report for people."""
    faults = "".join(f", {count} {kind}" for kind, count in report.faults.items())
    head = f"load {report.total:.1%}, reserved {report.reserved:.1%}, free slots used {report.free_used:.1%}{faults}"
    rows = _rows(report)
    columns = ["kind", "topic", "module", "frames_s", "kbit_s", "share"]
    return head + "\n" + (aligned(rows, columns) if rows else "")


def trouble(report: BusLoad) -> str | None:
    """What the user should know."""
    if report.total > 1.0:
        return (
            f"{report.total:.0%} is more than the bus can carry: this program was late to read it, and the driver does "
            "not stamp frames when they come; or another bit rate is meant (?bitrate=)"
        )
    if report.free_used <= CROWDED:
        return None
    gap = "none was seen" if report.nrt_gap is None else f"the longest pause was {report.nrt_gap / SECOND:.3f} s"
    return (
        f"{report.free_used:.0%} of the free slots are used: events wait long, non real-time traffic starves ({gap}); "
        "send less, or reserve slots for what is periodic (r2p bus admit)"
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


# How the commands of `r2p bus` get at a bus: the one rtcan: URL that was given, listened to and never written to.


SECOND = 1_000_000_000


@contextlib.asynccontextmanager
async def listen(via: list[str] | None) -> AsyncIterator[BusMonitor]:
    """Open the bus. Raises Usage when there is none, or more than one."""
    given = settings(via, tool=True).via
    urls = [url for url in given if url.startswith("rtcan:")]
    if len(urls) != 1:
        raise Usage(f"give one CAN bus, as in --via rtcan:can0 (not {' and '.join(urls or given) or 'none'})")
    check_urls(urls)
    async with BusMonitor(urls[0], on_status=say) as bus:
        yield bus
