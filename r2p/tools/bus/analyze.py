"""`r2p bus analyze`: worst-case response times of a message set, from a file or from what a live bus carries."""

import asyncio
import math
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p import analysis
from r2p.analysis import BusMessage, EventModel, FaultModel, MessageClass, ResponseBound, SlotAccuracy, SlotSupply
from r2p.analysis.dbc import read_dbc, write_dbc
from r2p.analysis.tables import MessageSet, read_csv, read_toml
from r2p.bus import Calendar, Refusal, Timing
from r2p.codecs import rtcan
from r2p.tools.bus.live import LiveBus, watch
from r2p.tools.bus.reported import ReportedBus, collect
from r2p.tools.bus.slots import grid
from r2p.tools.bus.traffic import listen
from r2p.tools.config import Settings, UsageError, settings
from r2p.tools.options import Format, Via, time_option
from r2p.tools.output import Output, Record, notify
from r2p.tools.session import join
from r2p.units import MILLISECOND, SECOND

_READERS = {".csv": read_csv, ".toml": read_toml, ".dbc": read_dbc}
_BITRATE, _SLOTS = 1_000_000, 60
_CAN = ("rtcan:", "r2psim:")
_WATCHED = 10.0  # s
_NAMED = 5  # late messages that the error names
_COLUMNS = ["name", "node", "class", "id", "bytes", "period_ms", "deadline_ms", "jitter_ms", "bound_ms", "result"]


class Conditions(msgspec.Struct, frozen=True):
    """What the user says of the bus beside its messages. `bit` in ns, `rate` in faults a second."""

    bit: int
    faults: FaultModel
    rate: float
    accuracy: SlotAccuracy
    management: float
    control: bool


class Report(msgspec.Struct):
    """The bounds, the reasons of messages without slots, the sums by name; of a live bus, what was assumed."""

    bounds: list[ResponseBound]
    refused: dict[str, str]
    summary: dict[str, Any]
    chances: dict[str, float] = {}
    assumed: list[str] = []


_File = Annotated[
    Path | None, typer.Argument(metavar="FILE", show_default=False, help="Messages: .csv, .toml or .dbc.")
]
_Duration = Annotated[float | None, time_option("--for", "Watch the bus of --via for this long; default: 10s.")]
_Bitrate = Annotated[
    int | None,
    typer.Option("--bitrate", min=10_000, metavar="BIT/S", help="Bit rate; default: the file's, else 1000000."),
]
_SlotCount = Annotated[
    int | None,
    typer.Option("--slots", min=2, max=rtcan.SLOTS_MAX, metavar="N", help="Slots per cycle of RTCAN; default: 60."),
]
_Faults = Annotated[
    int, typer.Option("--faults", min=0, metavar="N", help="Bit errors that may come at any time (plain CAN).")
]
_FaultRate = Annotated[
    float, typer.Option("--fault-rate", min=0.0, metavar="PER_S", help="How likely each is late, with random errors.")
]
_Ppm = Annotated[
    float, typer.Option("--ppm", min=0.0, max=10_000, metavar="PPM", help="How far off clocks are (RTCAN).")
]
_Jitter = Annotated[
    float | None, time_option("--jitter", "How much a node's latency varies, either way (RTCAN); default: 0.")
]
_Management = Annotated[
    float, typer.Option("--management", min=0.0, metavar="PER_S", help="Discovery messages a second of each node.")
]
_Control = Annotated[
    bool, typer.Option("--control/--no-control", help="Count what RTCAN itself sends, which may come at once.")
]
_Summary = Annotated[bool, typer.Option("--summary", help="Print the sums only, not the messages.")]
_Dbc = Annotated[Path | None, typer.Option("--dbc", metavar="FILE", help="Also write the messages as DBC.")]


async def analyze(
    file: _File = None,
    *,
    via: Via = None,
    duration: _Duration = None,
    bitrate: _Bitrate = None,
    slots: _SlotCount = None,
    cycle: Annotated[float | None, time_option("--cycle", "Nominal length of the cycle; default: 10ms.")] = None,
    faults: _Faults = 0,
    fault_gap: Annotated[float | None, time_option("--fault-gap", "... and one more each TIME.")] = None,
    fault_rate: _FaultRate = 0.0,
    ppm: _Ppm = 50.0,
    jitter: _Jitter = None,
    management: _Management = 0.0,
    control: _Control = True,
    summary: _Summary = False,
    dbc: _Dbc = None,
    format: Format = None,
) -> None:
    """Compute worst-case response times on a CAN bus.

    Of plain CAN by the identifiers, and of RTCAN for messages with a class: hrt, srt, nrt. FILE has them; or with
    --via rtcan:can0 they are measured on a live RTCAN bus, or on any other link asked of its modules. The exit code is
    1 if a deadline may be missed.

    Also: how much longer all frames may become until then, the guard that slots need, and the shortest safe slot.
    """
    output = Output(format)
    if (file is None) == (via is None):
        raise UsageError("give a FILE with messages, or --via for a live bus, as in --via rtcan:can0")
    found = MessageSet([]) if file is None else await asyncio.to_thread(_read, file)
    rate = bitrate or found.bitrate or _BITRATE
    conditions = Conditions(
        analysis.bit_time(rate),
        FaultModel(faults, round((fault_gap or 0) * SECOND)),
        fault_rate,
        SlotAccuracy(ppm, round((jitter or 0) * SECOND)),
        management,
        control,
    )
    if file is None:
        report = await _live(settings(via, tool=True), duration or _WATCHED, conditions, dbc=dbc is not None)
    elif any(each.message_class is not MessageClass.PLAIN for each in found.messages):
        length = cycle if cycle is not None or found.cycle is None else found.cycle / SECOND
        report = planned(found.messages, grid(slots or found.slots or _SLOTS, length, rate), conditions)
    else:
        report = plain(found.messages, conditions)
    if dbc is not None:
        await asyncio.to_thread(_write, dbc, write_dbc([each.message for each in report.bounds], rate))
    await _print(report, output, summary=summary)


def _read(file: Path) -> MessageSet:
    reader = _READERS.get(file.suffix.lower())
    if reader is None:
        raise UsageError(f"{file}: the name of a file of messages ends with {', '.join(_READERS)}")
    try:
        return reader(file.read_text(encoding="utf-8", errors="replace"))
    except OSError as error:
        raise r2p.Error(f"can't read {file}: {error.strerror}") from error
    except r2p.Error as error:
        raise r2p.Error(f"{file}: {error}") from error


def _write(file: Path, text: str) -> None:
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise r2p.Error(f"can't write {file}: {error.strerror}") from error


async def _live(chosen: Settings, duration: float, conditions: Conditions, *, dbc: bool) -> Report:
    """Return the report of a bus that carries messages now: listen to it, or ask its network."""
    found: LiveBus | ReportedBus
    if not chosen.via or any(url.startswith(_CAN) for url in chosen.via):
        async with listen(chosen) as bus:
            if not await bus.cycles(1, timeout=3.0):
                raise r2p.Error("no sync frames: no RTCAN master on this bus, so it has no slots")
            found = await watch(bus, duration)
    else:
        if dbc:
            raise UsageError("--dbc needs the identifiers of the frames: give --via rtcan:can0, or a FILE")
        async with join(chosen) as session:
            found = await collect(session, duration, conditions.bit)
    conditions = msgspec.structs.replace(conditions, bit=found.timing.bit)
    control = found.control if conditions.control else []
    report = slotted(found.declared, control, found.supply, conditions, {})
    report.assumed = found.assumed
    return report


# Plain CAN


def plain(messages: list[BusMessage], conditions: Conditions) -> Report:
    """Return the report of a set of plain frames."""
    unknown = [each.name for each in messages if each.period is None]
    if unknown:
        notify(f"{', '.join(unknown[:_NAMED])}: without a period; what has less priority than these has no bound")
    bit, faults = conditions.bit, conditions.faults
    limit = analysis.breakdown(messages, bit, faults)
    names = [each.name for each in messages] if conditions.rate else []
    return Report(
        analysis.response_bounds(messages, bit, faults),
        {},
        {
            "messages": len(messages),
            "load": round(analysis.utilisation(messages, bit), 4),
            "breakdown_scale": _rounded(limit.scale),
            "breakdown_load": _rounded(limit.utilisation),
        },
        {name: analysis.miss_probability(messages, name, bit, conditions.rate) for name in names},
    )


# RTCAN


def planned(messages: list[BusMessage], timing: Timing, conditions: Conditions) -> Report:
    """Return the report of a plan: its periodic messages get slots from the master's calendar, in their order."""
    calendar, refused = Calendar(timing.slots), {}
    if strange := [each.name for each in messages if each.message_class is MessageClass.PLAIN]:
        raise r2p.Error(f"{strange[0]} has no class: on RTCAN each message is hrt, srt or nrt")
    for index, each in enumerate(messages):
        if each.message_class is MessageClass.HRT:
            period = (each.period or timing.cycle) // timing.slot
            result = calendar.admit(index, period, each.frames, round_down=True)
            if isinstance(result, Refusal):
                refused[each.name] = result.text
    nodes = list(dict.fromkeys(each.node for each in messages))
    owners = {each.node for each in messages if each.message_class is MessageClass.HRT}
    rates = analysis.control_rates(nodes, owners) if conditions.control else {}
    control = analysis.management_load(rates, conditions.management)
    return slotted(messages, control, analysis.slot_supply(timing, calendar), conditions, refused)


def slotted(
    messages: list[BusMessage],
    control: list[BusMessage],
    supply: SlotSupply,
    conditions: Conditions,
    refused: dict[str, str],
) -> Report:
    """Return the report of messages in the slots of a cycle."""
    timing, accuracy = supply.timing, conditions.accuracy
    # By how much two nodes may start apart: up to a bit they arbitrate, then the later one sees a busy bus.
    apart = analysis.guard_time(timing.cycle, accuracy)
    model = EventModel(latency=2 * accuracy.jitter, ordered=apart < timing.bit)
    events = [each for each in messages if each.message_class in {MessageClass.SRT, MessageClass.NRT}]
    found = {each.message: each for each in analysis.event_bounds([*events, *control], supply, model)}
    limit = analysis.event_breakdown(events, control, supply, model)
    longest = max((each.longest for each in messages), default=0) * timing.bit
    return Report(
        [found.get(each) or _periodic(each, timing, accuracy, refused) for each in messages],
        refused,
        {
            "messages": len(messages),
            "load": round(analysis.utilisation([*messages, *control], timing.bit), 4),
            "reserved": round(1 - supply.share, 4),
            "breakdown_scale": _rounded(limit.scale),
            "breakdown_load": _rounded(limit.utilisation),
            "order": "laxity" if model.ordered else "any",
            "slot_us": timing.slot / 1000,
            "guard_us": (timing.slot - longest) / 1000 - 3 * timing.bit / 1000,
            "guard_needed_us": apart / 1000,
            "guard_needed_without_sync_us": analysis.guard_time(timing.cycle, accuracy, 3) / 1000,
            "smallest_slot_us": analysis.smallest_slot(timing.slots, timing.bit, accuracy) / 1000,
        },
    )


def _periodic(message: BusMessage, timing: Timing, accuracy: SlotAccuracy, refused: dict[str, str]) -> ResponseBound:
    """Return the bound of a message in slots of its own, from the start of the first one."""
    if message.name in refused:
        return ResponseBound(message, None)
    slots = (message.frames - 1) * timing.slot
    return ResponseBound(message, slots + message.longest * timing.bit + 2 * accuracy.jitter)


# Output


async def _print(report: Report, output: Output, *, summary: bool) -> None:
    for line in report.assumed:
        notify(f"assumed: {line}")
    if summary:
        await output.put(report.summary, _in_words(report.summary))
    else:
        columns = [*_COLUMNS, "p_late"] if report.chances else _COLUMNS
        await output.table([_row(each, report) for each in report.bounds], columns)
        await output.remark("\n" + _in_words(report.summary))
    late = [each.message.name for each in report.bounds if _is_late(each, report)]
    if late:
        more = f" and {len(late) - _NAMED} others" if len(late) > _NAMED else ""
        raise r2p.Error(f"{len(late)} of {len(report.bounds)} messages may be late: {', '.join(late[:_NAMED])}{more}")


def _is_late(found: ResponseBound, report: Report) -> bool:
    return found.misses or found.message.name in report.refused


def _row(found: ResponseBound, report: Report) -> Record:
    message = found.message
    row: dict[str, Any] = {
        "name": message.name,
        "node": message.node,
        "class": message.message_class.value,
        "id": f"0x{message.id:X}",
        "bytes": message.size,
        "period_ms": _ms(message.period),
        "deadline_ms": _ms(message.deadline),
        "jitter_ms": _ms(message.jitter),
        "bound_ms": _ms(found.bound),
        "result": report.refused.get(message.name) or _result(found),
    }
    if report.chances:
        row["p_late"] = float(f"{report.chances[message.name]:.3g}")
    return row


def _result(found: ResponseBound) -> str:
    if found.misses:
        return "late"
    return "no bound" if found.bound is None else "in time"


def _ms(time: int | None) -> float | None:
    return None if time is None else round(time / MILLISECOND, 6)


def _rounded(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def _in_words(summary: dict[str, Any]) -> str:
    scale, load = summary["breakdown_scale"], summary["breakdown_load"]
    lines = [f"load {summary['load']:.1%}" + (f", reserved {summary['reserved']:.1%}" if "reserved" in summary else "")]
    if "order" not in summary:
        return f"{lines[0]}; all deadlines hold until all frames are {scale} times as long, at a load of {load:.1%}"
    if scale is not None:
        lines.append(f"all deadlines hold until events come {scale} times as often, in {load:.1%} of the free slots")
    if summary["order"] == "any":
        lines.append("nodes may start more than a bit apart: laxity does not decide, and the bounds are for any order")
    needed, without = summary["guard_needed_us"], summary["guard_needed_without_sync_us"]
    lines += [
        f"slots of {summary['slot_us']:g} us have a guard of {summary['guard_us']:.3g} us",
        f"needed are {needed:.3g} us, and {without:.3g} us after three lost syncs",
        f"the shortest safe slot has {summary['smallest_slot_us']:g} us",
    ]
    return "\n".join(lines)
