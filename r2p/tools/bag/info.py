"""`r2p bag info`: what is in a recording, and what is missing."""

from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2p.codecs import PublisherClass
from r2p.tools.bag.files import File, opened, run_steps, size_text
from r2p.tools.bag.times import iso, length, shown
from r2p.tools.options import CLASS_NAMES, Format
from r2p.tools.output import Output
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.recording.bag import Bag
    from r2p.recording.channels import BagChannel

_CHUNKS_AT_ONCE = 200  # with messages about losses, which are read without --all: some ten milliseconds
_TOPIC_COLUMNS = ["topic", "type", "count", "rate", "publishers", "class", "link"]
_CHANNEL_COLUMNS = ["channel", "type", "count"]
_LOSS_COLUMNS = ["of", "cause", "count"]


async def info(
    file: File,
    *,
    all: Annotated[
        bool, typer.Option("--all", "-a", help="Count all losses, and check that every chunk can be read.")
    ] = False,
    format: Format = None,
) -> None:
    """Show what is in a recording, and what was lost.

    The rate of a topic is that between its first and its last message. CSV has the topics.
    """
    output = Output(format)
    with opened(file) as bag:
        if all:
            await run_steps(bag.check())
        record = _record(bag, count_all=all)
    topics, channels, losses = record["topics"], record["channels"], record["losses"]
    if output.format == "text":
        for line in _head(record):
            await output.remark(line)
        topics = [each | {"rate": each["rate"] and f"{each['rate']:g} Hz"} for each in topics]
        for rows, columns in (
            (topics, _TOPIC_COLUMNS),
            (_joined(channels), _CHANNEL_COLUMNS),
            (losses, _LOSS_COLUMNS),
        ):
            if rows:
                await output.remark("")
                await output.table(rows, columns)
    elif output.format == "csv":
        await output.table(topics, _TOPIC_COLUMNS)
    else:
        await output.put(record)


def _record(bag: "Bag", *, count_all: bool) -> dict[str, Any]:
    """Return all that is known of a recording; times are in ns since 1970, the duration is in seconds."""
    chunks = [chunk for file in bag.files for chunk in file.summary.chunks]
    losses, uncounted = _losses(bag, count_all=count_all)
    return {
        "files": [{"path": str(each.file.path), "size": each.file.size} for each in bag.files],
        "written_by": sorted({each.summary.library for each in bag.files if each.summary.library}),
        "start": iso(bag.start) if bag.start else None,
        "end": iso(bag.end) if bag.end else None,
        "start_ns": bag.start,
        "end_ns": bag.end,
        "duration": (bag.end - bag.start) / SECOND,
        "messages": sum(bag.topics.values()),
        "chunks": len(chunks),
        "compression": sorted({each.compression or "none" for each in chunks}),
        "packed_bytes": sum(each.length for each in chunks),
        "unpacked_bytes": sum(each.size for each in chunks),
        "topics": _topics(bag),
        "channels": _channels(bag),
        "losses": losses,
        "uncounted": uncounted,
        "attachments": sorted({index.name for each in bag.files for index in each.summary.attachments}),
        "metadata": bag.metadata,
        "problems": bag.problems,
        "damaged_chunks": bag.damaged,
    }


def _head(record: dict[str, Any]) -> Iterable[str]:
    """Yield the lines above the tables."""
    from r2p.recording.messages import LOSSES

    files = record["files"]
    size = sum(each["size"] for each in files)
    more = f" and {len(files) - 1} more files" if len(files) > 1 else ""
    yield f"file         {files[0]['path']}{more}, {size_text(size)}{_compression(record)}"
    if record["start_ns"]:
        start, end = shown(record["start_ns"]), shown(record["end_ns"])
        end = end.removeprefix(start[:11])  # the date, if it is the same
        yield f"recorded     {length(record['end_ns'] - record['start_ns'])}, {start} to {end}"
    if record["written_by"]:
        yield f"written by   {', '.join(record['written_by'])}"
    topics = len(record["topics"])
    yield f"messages     {record['messages']} of {topics} topic{'' if topics == 1 else 's'}"
    if record["attachments"]:
        yield f"attachments  {', '.join(record['attachments'])}"
    if record["damaged_chunks"]:
        count = record["damaged_chunks"]
        yield f"damaged      {count} chunk{'s' * (count != 1)}, whose messages can't be read"
    is_watched = any(each["channel"] == LOSSES for each in record["channels"])
    if is_watched and not (record["losses"] or record["uncounted"]):
        yield "lost         nothing, by what the recorder knows"
    if record["uncounted"]:
        yield f"not counted  losses in {', '.join(record['uncounted'])}: --all reads these"


def _compression(record: dict[str, Any]) -> str:
    unpacked = record["unpacked_bytes"]
    if not unpacked or record["compression"] == ["none"]:
        return ""
    return f" ({', '.join(record['compression'])}, {record['packed_bytes'] / unpacked:.0%} of {size_text(unpacked)})"


def _topics(bag: "Bag") -> list[dict[str, Any]]:
    """Return the rows of all topics."""
    channels: dict[str, list[BagChannel]] = {name: [] for name in bag.topics}
    for each in bag.channels:
        if each.kind == "samples" and each.info:
            channels[each.info.topic].append(each)
    ids: list[dict[object, list[int]]] = [{} for _ in bag.files]
    for file, by_key in zip(bag.files, ids, strict=True):
        for number, channel in file.channels.items():
            by_key.setdefault(channel.key, []).append(number)
    return [_topic(bag, name, of_topic, ids) for name, of_topic in channels.items()]


def _topic(bag: "Bag", name: str, channels: "list[BagChannel]", ids: list[dict[object, list[int]]]) -> dict[str, Any]:
    """Return the row of a topic, with all of its channels; `ids` are those of channels in each file, by their keys."""
    infos = [each.info for each in channels if each.info]
    count = sum(each.count for each in channels)
    publishers = {f"{each.module or '?'}/{each.node}" if each.node else each.module for each in infos}
    publishers -= {each.module for each in infos if each.node}  # the same one, before its node was known
    return {
        "topic": name,
        "type": " ".join(sorted({each.type_name for each in channels if each.type_name})) or None,
        "count": count,
        "rate": _rate(bag, channels, ids, count),
        "publishers": sorted(filter(None, publishers)),
        "class": sorted({_class_name(each.publisher_class) for each in infos if each.module or each.node}),
        "link": sorted({each.link for each in infos if each.link}),
    }


def _class_name(publisher_class: PublisherClass) -> str:
    return CLASS_NAMES[publisher_class]


def _rate(bag: "Bag", channels: "list[BagChannel]", ids: list[dict[object, list[int]]], count: int) -> float | None:
    """Return the messages per second between the first and the last one of these channels."""
    if count < 2:
        return None
    found = []
    for file, by_key in zip(bag.files, ids, strict=True):
        own = frozenset(number for each in channels for number in by_key.get(each.key, ()))
        chunks = [each for each in file.summary.chunks if each.may_have(own)]
        if chunks:
            found += [(file, min(chunks, key=lambda each: each.start), own)]
            found += [(file, max(chunks, key=lambda each: each.end), own)]
    times = [time for file, chunk, own in found for time, channel in file.times(chunk) if channel in own]
    duration = max(times, default=0) - min(times, default=0)
    return float(f"{(count - 1) * SECOND / duration:.3g}") if duration > 0 else None


def _channels(bag: "Bag") -> list[dict[str, Any]]:
    """Return the rows of the other channels; one row for all of a name."""
    counts: Counter[tuple[str, str]] = Counter()
    for each in bag.channels:
        if each.kind == "messages":
            counts[each.name, each.type_name or each.encoding] += each.count
    return [{"channel": name, "type": kind, "count": count} for (name, kind), count in sorted(counts.items())]


def _joined(channels: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows for a terminal, with one for all parts of the load of a bus: a robot has dozens of these."""
    from r2p.recording.messages import BUS_LOADS

    rows: dict[str, dict[str, Any]] = {}
    for each in channels:
        name = each["channel"]
        parts = name.removeprefix(f"{BUS_LOADS}/").split("/")
        if name.startswith(f"{BUS_LOADS}/") and len(parts) > 1 and f"{BUS_LOADS}/{parts[0]}" in rows:
            name = f"{BUS_LOADS}/{parts[0]}/*"
        row = rows.setdefault(name, {**each, "channel": name, "count": 0})
        row["count"] += each["count"]
    return list(rows.values())


# What was lost


def _losses(bag: "Bag", *, count_all: bool) -> tuple[list[dict[str, Any]], list[str]]:
    """Return what was lost, of which topic and for which cause, and the channels that were not read for that."""
    from r2p.recording import messages as own

    counts: Counter[tuple[str, str]] = Counter()
    uncounted = []
    _add_recorder(bag, counts)
    details = {each.name for each in bag.channels if each.name.endswith("/frames/details")}
    sources = {own.SIGNALS: _add_signals, own.EVENTS: _add_events} | dict.fromkeys(sorted(details), _add_frames)
    for channel, add in sources.items():
        if count_all or _chunks_with(bag, channel) <= _CHUNKS_AT_ONCE:
            add(bag, channel, counts)
        else:
            uncounted.append(channel)
    rows = [{"of": of, "cause": cause, "count": count} for (of, cause), count in counts.most_common() if count]
    return rows, uncounted


def _chunks_with(bag: "Bag", channel: str) -> int:
    """Return the number of chunks that have messages of a channel."""
    found = 0
    for file in bag.files:
        ids = {number for number, each in file.channels.items() if each.name == channel}
        found += sum(each.may_have(ids) for each in file.summary.chunks)
    return found


def _add_recorder(bag: "Bag", counts: Counter[tuple[str, str]]) -> None:
    """Add what the recorder lost itself, which its last message says."""
    from r2p.recording.messages import LOSSES, RecorderLosses

    last = {}
    for each in bag.messages(LOSSES, RecorderLosses, start=_last_chunk(bag, LOSSES)):
        last[each.channel.key, each.channel] = each.message
    lost: dict[object, Counter[tuple[str, str]]] = {}
    for (key, _), message in last.items():
        own: Counter[tuple[str, str]] = Counter()
        for topic in message.topics:
            own[topic.topic, "the recorder's disk was too slow or full"] = topic.dropped
            own[topic.topic, "lost before the recorder"] = topic.missed
        lost[key] = lost.get(key, Counter()) | own  # parts of a recording count on: the largest is all of it
    for each_own in lost.values():
        counts.update(+each_own)


def _last_chunk(bag: "Bag", channel: str) -> int:
    """Return when the last chunk with messages of a channel begins, in the file in which that is earliest."""
    starts = []
    for file in bag.files:
        ids = {number for number, each in file.channels.items() if each.name == channel}
        found = [each for each in file.summary.chunks if each.may_have(ids)]
        starts += [max(each.start for each in found)] if found else []
    return min(starts, default=0)


def _add_signals(bag: "Bag", channel: str, counts: Counter[tuple[str, str]]) -> None:
    """Add messages that publishers, links and subscribers missed, or sent late."""
    from r2p.recording.messages import RecordedSignal

    for each in bag.messages(channel, RecordedSignal):
        signal = each.message
        detail = signal.reason or (f"by {signal.where}" if signal.where else "")
        cause = ": ".join(filter(None, (signal.kind, detail)))
        counts[signal.topic or signal.module, cause] += signal.count


def _add_events(bag: "Bag", channel: str, counts: Counter[tuple[str, str]]) -> None:
    """Add outages of links, with the messages that were lost in them, and events that were too many."""
    from r2p.recording.messages import RecordedEvent

    for each in bag.messages(channel, RecordedEvent):
        event = each.message
        if event.kind == "link down" and event.text != "as the recording began":
            counts[event.link, "link down"] += 1
        elif event.kind == "link up" and event.count:
            counts[event.link, "messages lost while the link was down"] += event.count
        elif event.kind == "events lost":
            counts[channel, "too many events for the recorder"] += event.count


def _add_frames(bag: "Bag", channel: str, counts: Counter[tuple[str, str]]) -> None:
    """Add CAN frames that were on the bus and are not in the file."""
    from r2p.recording.frames import FrameDetails

    for each in bag.messages(channel, FrameDetails):
        if each.message.event == "lost":
            counts[channel.removesuffix("/details"), each.message.text] += each.message.count
