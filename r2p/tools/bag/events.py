"""`r2p bag events` and `r2p bag slots`: what happened in a recording, and who owned which slot."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2p.tools.bag.files import File, opened
from r2p.tools.bag.times import End, Start, moment_option, shown, span
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError

if TYPE_CHECKING:
    from r2p.recording.bag import Bag
    from r2p.recording.timeline import TimelineEvent

_KINDS = (
    *("link", "module", "master", "slots", "missed", "late", "overdue", "lost", "degraded"),
    *("log", "parameter", "notice", "recorder"),
)
_GROUPS = {"misses": {"missed", "late", "overdue", "lost", "degraded"}}
_RED = frozenset({"missed", "lost", "recorder"})
_YELLOW = frozenset({"late", "overdue", "degraded", "log"})
_WIDTH = max(map(len, _KINDS))


def complete_kind(incomplete: str) -> list[str]:
    """Complete the kinds of --only."""
    return [each for each in (*_GROUPS, *_KINDS) if each.startswith(incomplete)]


async def events(
    file: File,
    *,
    start: Start = None,
    end: End = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            metavar="KIND",
            autocompletion=complete_kind,
            help="link, module, master, slots, missed, late, overdue, lost, degraded, log, parameter, notice, "
            "recorder; or misses for the five from missed on (repeatable).",
            show_default=False,
        ),
    ] = None,
    each: Annotated[bool, typer.Option("--each", help="A line for each miss, also for those within a second.")] = False,
    format: Format = None,
) -> None:
    """Print what happened: links, elections, slots, misses.

    Also changes of parameters, warnings and losses. `r2p bag record` writes it besides the topics. At a terminal, what
    repeats within a second is one line.
    """
    from r2p.recording.timeline import collapsed, timeline  # only here, as it takes a while

    kinds = _chosen(only or [])
    output = Output(format)
    with opened(file) as bag:
        first, last = span((bag.start, bag.end), start, end)
        found = (event for event in timeline(bag, first, last) if not kinds or event.kind in kinds)
        counts: dict[str, int] = {}
        for event in found if each or output.format != "text" else collapsed(found):
            counts[event.kind] = counts.get(event.kind, 0) + (event.count or 1)
            await output.put(_record(event), _line(event), colour=_colour(event), wrap=True)
        _summarise(bag, counts, first, last)


def _chosen(only: list[str]) -> set[str]:
    kinds: set[str] = set()
    for each in only:
        if each not in _GROUPS and each not in _KINDS:
            raise UsageError(f"--only {each}: choose of {', '.join((*_GROUPS, *_KINDS))}")
        kinds |= _GROUPS.get(each, {each})
    return kinds


def _summarise(bag: "Bag", counts: dict[str, int], first: int | None, last: int | None) -> None:
    """Print the sums of misses, or the possible reasons for an empty result."""
    from r2p.recording.messages import EVENTS

    when = f"from {shown(first or bag.start)} to {shown(last or bag.end, date=False)}"
    misses = ", ".join(f"{counts[kind]} {kind}" for kind in _KINDS if kind in counts and kind in _GROUPS["misses"])
    if misses:
        notify(f"{when}: {misses}")
    elif not counts:
        observed = any(each.name == EVENTS for each in bag.channels)
        why = "" if observed else ": this recording has only messages, made with --no-events, or by another program"
        notify(f"nothing {when}{why}")


def _record(event: "TimelineEvent") -> dict[str, Any]:
    return {
        "stamp": event.time,
        "kind": event.kind,
        "about": event.about,
        "text": event.text,
        "count": event.count,
        "late": event.late,
        "sequence": event.sequence,
    }


def _line(event: "TimelineEvent") -> str:
    details = [event.text]
    if event.late:
        most = "at most " if event.until else ""
        details.append(f"{most}{event.late * 1e3:.1f} ms late")
    if event.until:
        details.append(f"{event.count} until {shown(event.until, date=False)}")
    elif event.count > 1:
        details.append(f"{event.count} messages")
    elif event.sequence and event.count:
        details.append(f"message {event.sequence}")
    time = shown(event.time, date=False)
    about = f"{event.about}: " if event.about else ""
    return f"{time} {event.kind:<{_WIDTH}} {about}{', '.join(details)}"


def _colour(event: "TimelineEvent") -> int | None:
    bad = event.kind == "link" and not event.text.startswith("up")
    silent = event.kind == "module" and event.text.startswith(("silent", "no answer"))
    if event.kind in _RED or bad or silent or (event.kind == "slots" and "lost" in event.text):
        return 31
    return 33 if event.kind in _YELLOW or event.text.startswith("no RTCAN master") else None


async def slots(
    file: File,
    *,
    at: Annotated[Any, moment_option("--at", "When: 12.5, -10s, 14:03:05, ISO 8601; default: at the end.")] = None,
    format: Format = None,
) -> None:
    """Print who owned which slot of an RTCAN bus, and when."""
    from r2p.recording.timeline import slots_at

    with opened(file) as bag:
        time = bag.end if at is None else at.instant(bag.start, bag.end)
        if not bag.start <= time <= bag.end:
            raise UsageError(f"--at {at.text}: the recording is from {shown(bag.start)} to {shown(bag.end)}")
        tables = slots_at(bag, time)
    rows = [
        {"bus": table.bus, "slots": list(owner.slots), "topic": owner.topic or "(unused)", "module": owner.module}
        for table in tables
        for owner in table.owners
    ]
    await Output(format).table(rows, ["bus", "slots", "topic", "module"])
    for table in tables:
        cycle = f"{table.slots_in_cycle} slots in a cycle of {table.cycle * 1e3:.3g} ms"
        notify(f"{table.bus} at {shown(time)}: {cycle}; the master is {table.master or 'unknown'}")
    if not tables:
        notify(f"nothing is known of slots at {shown(time)}: the recording saw no RTCAN bus with a master then")
