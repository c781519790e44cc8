"""`r2p bag record`: record topics into a file, until Ctrl-C."""

import asyncio
import contextlib
import functools
import logging
import os
import re
import signal
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

import r2p
from r2p.clock import local_time
from r2p.ros.std_srvs import Trigger
from r2p.tools.bag.files import size_text
from r2p.tools.completion import complete_topic
from r2p.tools.config import find
from r2p.tools.keyboard import on_key
from r2p.tools.options import Format, byte_size, long_seconds, topic_pattern
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, Settings, UsageError, call_after, wait_until
from r2p.tools.topic.watching import HINT_AFTER, is_published, suggest_topics
from r2p.tools.types import Types
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.recording.entries import BagEntry
    from r2p.recording.frame_recorder import FrameRecorder
    from r2p.recording.recorder import Part, Recorder
    from r2p.recording.recording_files import RecordingOptions

SNAPSHOT_SERVICE = "bag/snapshot"
"""The service, of type std_srvs/Trigger, that writes the last seconds into a file."""

_NICENESS = 5
"""The priority of the process for the operating system: 0 is that of others, 19 the lowest."""

_MIN_FREE = 1_000_000_000  # bytes
_ANSWER_MAX = 160  # characters of an answer to that service, which all links carry
_LINK_UP = 2.0  # seconds to wait for a link before the recording begins: others may come later
_OTHERS = (".bag", ".db3", ".log", ".blf", ".asc", ".csv", ".parquet")
_LIMITS = ("max_size", "max_duration", "split", "snapshot", "min_free", "max_total")


def check(settings: Settings, given: Mapping[str, Any]) -> None:
    """Raise UsageError for topics and options that make no sense."""
    if not given["topics"] and not given["all"] and not given["frames"]:
        raise UsageError("nothing to record: name topics, such as odometry or 'camera/*', or give -a for all")
    if given["topics"] and given["all"]:
        raise UsageError("-a records all topics: leave out either -a or the topics; --exclude leaves out some")
    for option, texts in (("TOPIC", given["topics"]), ("--exclude", given["exclude"])):
        for each in texts or ():
            topic_pattern(each.removeprefix("/"), option)
    if not settings.via:
        raise UsageError("no network to record: give --via tcp:HOST:PORT or set R2P_VIA")
    if given["frames"] and not _buses(settings):
        raise UsageError("--frames records the CAN buses of --via: give --via rtcan:can0 (or a sim: URL)")
    if given["frames"] and has_topics(given):
        _check_buses(settings)
    _stated_types(settings, given["topics"], given["type"])
    _options({name: given[name] for name in _LIMITS})
    output = given["output"]
    if output is not None:
        _check_output(output)


def _check_output(output: Path) -> None:
    if output.exists():
        raise UsageError(f"{output} exists, and is never overwritten: give another -o FILE")
    if not output.parent.is_dir():
        raise UsageError(f"-o {output}: there is no directory '{output.parent}'")
    if output.suffix in _OTHERS:
        raise UsageError(f"-o {output}: a recording is an .mcap file; r2p bag convert makes {output.suffix} of it")


def has_topics(given: Mapping[str, Any]) -> bool:
    """Return whether topics are recorded. For frames alone the command sends nothing: the bus may not speak RTCAN."""
    return bool(given["topics"] or given["all"])


def _check_buses(settings: Settings) -> None:
    from r2p.recording.frame_recorder import is_shareable  # only here, as it takes a while

    for url in _buses(settings):
        if not is_shareable(url):
            raise UsageError(
                f"{url} can be opened once: record its frames without topics, or its topics without frames"
            )


_Topics = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="TOPIC", autocompletion=complete_topic, help="Names, patterns such as 'camera/*'.", show_default=False
    ),
]
_All = Annotated[bool, typer.Option("--all", "-a", help="All topics, also those that appear later.")]
_FILE = "Default: r2p-YYYYMMDD-HHMMSS.mcap here."
_Output = Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help=_FILE, show_default=False)]
_Exclude = Annotated[
    list[str] | None, typer.Option("--exclude", metavar="PATTERN", help="Leave these topics out (repeatable).")
]
_NoEvents = Annotated[bool, typer.Option("--no-events", help="Only messages: no links, misses, slots, parameters.")]
_Frames = Annotated[bool, typer.Option("--frames", help="All frames of the CAN buses of --via, too.")]
_StatedTypes = Annotated[
    list[str] | None,
    typer.Option("--type", metavar="TOPIC=TYPE", help="Types that no module announces (repeatable)."),
]
_Split = Annotated[bool, typer.Option("--split", help="Go on in another file there: FILE-0001.mcap, ...-0002.mcap.")]


def _size(name: str, help: str) -> Any:
    return typer.Option(name, parser=byte_size, metavar="SIZE", help=help)


def _time(name: str, help: str) -> Any:
    return typer.Option(name, parser=long_seconds, metavar="TIME", help=help)


async def record(
    session: Session,
    topics: _Topics = None,
    *,
    all: _All = False,
    output: _Output = None,
    exclude: _Exclude = None,
    no_events: _NoEvents = False,
    frames: _Frames = False,
    type: _StatedTypes = None,
    max_size: Annotated[int | None, _size("--max-size", "End at this size: 500M, 2G.")] = None,
    max_duration: Annotated[float | None, _time("--max-duration", "End after this long: 90, 10m, 2h.")] = None,
    split: _Split = False,
    max_total: Annotated[int | None, _size("--max-total", "With --split: delete the oldest files.")] = None,
    min_free: Annotated[int | None, _size("--min-free", "End when less is free; default: 1G, 0: off.")] = None,
    snapshot: Annotated[
        float | None, _time("--snapshot", f"Keep this long in memory; SIGUSR1, s and {SNAPSHOT_SERVICE} write it.")
    ] = None,
    format: Format = None,
) -> None:
    """Record topics into a file, until Ctrl-C.

    Nothing waits for the recorder; what it loses is counted, and printed at the end.
    """
    from r2p.recording.recorder import Recorder  # only here, as it takes a while

    if all or topics:
        with session.waiting("a link"):  # so that there is no file of a network that can't be reached
            await wait_until(lambda: any(link.up for link in session.module.links), _LINK_UP)
    if frames:
        await _open_buses(session.settings)
    limits = (max_size, max_duration, split, snapshot, min_free, max_total)
    buses: list[FrameRecorder] = []
    recorder = Recorder(
        session.module,
        output or Path(local_time(session.module.space.clock.now(), "r2p-%Y%m%d-%H%M%S.mcap")),
        None if all else topics or [],
        exclude=exclude or (),
        types=_stated_types(session.settings, topics, type),
        options=_options(dict(zip(_LIMITS, limits, strict=True))),
        parts=_parts(session.settings, buses if frames else None, events=not no_events),
    )
    if not session.module.space.clock.virtual:
        lower_priority()
    await _record(session, recorder, Output(format), topics or [], buses)


def lower_priority() -> None:
    """Let other processes go first, such as those of the robot's nodes, in all threads of this one."""
    threads = Path("/proc/self/task")
    for thread in [int(each.name) for each in threads.iterdir()] if threads.exists() else [0]:
        with contextlib.suppress(OSError):  # it has ended meanwhile
            os.setpriority(os.PRIO_PROCESS, thread, max(_NICENESS, os.getpriority(os.PRIO_PROCESS, thread)))


async def _record(
    session: Session, recorder: "Recorder", output: Output, topics: list[str], buses: "list[FrameRecorder]"
) -> None:
    clock = session.module.space.clock
    began = clock.monotonic()
    try:
        with _ending_at_hangup():
            async with recorder:
                with _snapshots(session, recorder), _hints(session, topics):
                    await recorder.wait()
    except OSError as error:
        raise r2p.Error(f"can't write {recorder.path}: {error.strerror}") from error
    finally:
        if recorder.started:
            await _print_summary(recorder, buses, output, (clock.monotonic() - began) / SECOND)
    if not recorder.stopped.startswith("max_"):
        raise r2p.Error(f"the recording has ended early: {recorder.stopped}")


async def _print_summary(recorder: "Recorder", buses: "list[FrameRecorder]", output: Output, seconds: float) -> None:
    """Print what was recorded and lost, by topic and bus."""
    from r2p.recording.recorder import TopicCount

    counts = recorder.counts()
    for each in buses:
        dropped = counts.get(each.bus.topic, TopicCount()).dropped
        counts[each.bus.topic] = TopicCount(each.frames, dropped, each.lost.total())
    total = sum(each.messages - each.dropped for each in counts.values())
    files = ", ".join(map(str, recorder.paths)) or "no file"
    what = "snapshots" if recorder.keeps else size_text(recorder.bytes_written)
    limit, _, reached = recorder.stopped.partition(" ")
    why = f"; --{limit.replace('_', '-')} {reached}" if limit in _LIMITS else ""
    notify(f"{total} messages in {seconds:.1f} s; {what}: {files}{why}")
    rows = [{"topic": topic, **msgspec.structs.asdict(each)} for topic, each in counts.items()]
    await output.table(rows, ["topic", "messages", "dropped", "missed"])


@contextlib.contextmanager
def _ending_at_hangup() -> Iterator[None]:
    """End the file as at Ctrl-C when the terminal, or the connection to this computer, is closed; not with nohup."""
    ending = False

    def end() -> None:
        nonlocal ending
        if not ending:  # the kernel and the shell may send one each
            ending = True
            signal.raise_signal(signal.SIGTERM)

    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        yield
        return
    with _on_signal(signal.SIGHUP, end):
        yield


@contextlib.contextmanager
def _hints(session: Session, topics: list[str]) -> Iterator[None]:
    """Report after a while which of the topics have no publisher."""

    def report() -> None:
        views = session.module.network.topics()
        names = [each.removeprefix("/") for each in topics]
        for name in names:
            if not any(fnmatchcase(each, name) for each, view in views.items() if is_published(view)):
                notify(f"{name} has no publisher yet{suggest_topics(session, name, is_published)}")
        if not names and session.module.links and not any(map(is_published, views.values())):
            notify(session.none_yet("topics"))

    with call_after(HINT_AFTER, report):
        yield


@contextlib.contextmanager
def _snapshots(session: Session, recorder: "Recorder") -> Iterator[None]:
    """Write a snapshot at SIGUSR1, at the key s, and when the service is called.

    Raises Error at the end if one could not be written.
    """
    if not recorder.keeps:
        with _on_signal(signal.SIGUSR1, lambda: notify("there is no snapshot to write: start with --snapshot 30s")):
            notify(f"recording into {recorder.path}; Ctrl-C ends it")
            yield
        return
    tasks: set[asyncio.Task[Trigger.Response]] = set()
    failed: list[OSError] = []

    async def write(_request: Trigger.Request | None = None) -> Trigger.Response:
        try:
            path = await recorder.snapshot()
        except r2p.Error as error:
            notify(f"no snapshot: {error}")
            return Trigger.Response(success=False, message=f"{error}"[:_ANSWER_MAX])
        except OSError as error:
            failed.append(error)
            why = f"can't write {error.filename or recorder.path}: {error.strerror}"
            notify(f"no snapshot: {why}; the last seconds are still kept: try again when that is solved")
            return Trigger.Response(success=False, message=why[-_ANSWER_MAX:])  # its end says what is wrong
        notify(f"snapshot: {path}")
        return Trigger.Response(success=True, message=f"{path}"[-_ANSWER_MAX:])

    def start() -> None:
        task = asyncio.create_task(write())
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    session.node.log.logger.setLevel(logging.ERROR)  # it would warn of answers that are too long: see _ANSWER_MAX
    session.node.serve(SNAPSHOT_SERVICE, Trigger, write)
    with _on_signal(signal.SIGUSR1, start), on_key(lambda key: start() if key == "s" else None) as has_keyboard:
        how = "s writes them" if has_keyboard else f"SIGUSR1 and the service {SNAPSHOT_SERVICE} write them"
        notify(f"keeping the last seconds in memory; {how}, Ctrl-C ends it")
        try:
            yield
        except asyncio.CancelledError as error:
            if failed:
                count = "1 snapshot" if len(failed) == 1 else f"{len(failed)} snapshots"
                raise r2p.Error(f"{count} could not be written") from error
            raise


@contextlib.contextmanager
def _on_signal(number: signal.Signals, call: Callable[[], object]) -> Iterator[None]:
    loop = asyncio.get_running_loop()
    try:
        loop.add_signal_handler(number, call)
    except (NotImplementedError, RuntimeError, ValueError):  # under virtual time, or not in the main thread
        yield
        return
    try:
        yield
    finally:
        loop.remove_signal_handler(number)


def _buses(settings: Settings) -> list[str]:
    """Return the URLs of CAN buses."""
    from r2p.recording.frame_recorder import CAN_SCHEMES  # only here, as it takes a while

    return [url for url in settings.via if url.startswith(CAN_SCHEMES)]


async def _open_buses(settings: Settings) -> None:
    """Try to open each CAN bus before the file is made. Raises TransportError."""
    from r2p.recording.frame_recorder import FrameRecorder  # only here, as it takes a while

    for url in _buses(settings):
        async with FrameRecorder(url, lambda _entries: None):
            pass


def _parts(settings: Settings, buses: "list[FrameRecorder] | None", *, events: bool) -> "list[Part]":
    """Return what is recorded besides topics: what happens on the network, r2p.toml, and frames.

    The recorders of frames enter `buses`; None: no frames.
    """
    from r2p.recording.frame_recorder import frames_of  # only here, as it takes a while
    from r2p.recording.observations import Observations

    file = find()
    files = {} if file is None else {file.name: ("application/toml", file.read_bytes())}

    def of_bus(url: str) -> "Part":
        make = frames_of(url, report=notify)

        def begin(module: r2p.Module, add: "Callable[[BagEntry], object]") -> "FrameRecorder":
            assert buses is not None
            recorder = make(module, add)
            buses.append(recorder)
            return recorder

        return begin

    observations: list[Part] = [functools.partial(Observations, files=files)] if events else []
    return [*observations, *(of_bus(url) for url in _buses(settings) if buses is not None)]


def _options(limits: Mapping[str, Any]) -> "RecordingOptions":
    """Return the options of the file. Raises UsageError for some that don't go together."""
    from r2p.recording.recording_files import RecordingOptions  # only here, as it takes a while

    given = {name: value for name, value in limits.items() if value is not None}
    try:
        return RecordingOptions(**{"min_free": _MIN_FREE, **given})
    except ValueError as error:
        text = re.sub(rf"\b({'|'.join(_LIMITS)})\b(?! of)", lambda name: f"--{name[0].replace('_', '-')}", f"{error}")
        raise UsageError(text) from error


def _stated_types(
    settings: Settings, topics: list[str] | None, given: list[str] | None
) -> dict[str, type[r2p.Message]]:
    """Return the types of topics that --type or r2p.toml state. Raises UsageError."""
    types = Types(settings)
    stated = types.stated_topics()
    for text in given or ():
        topic, equals, name = text.partition("=")
        if not equals and topics is not None and len(topics) == 1:
            topic, name = topics[0], text
        if not (topic and name):
            raise UsageError(f"--type {text}: write it as TOPIC=TYPE, such as odometry=nav_msgs/Odometry")
        stated[topic.removeprefix("/")] = types.load(name)
    return stated
