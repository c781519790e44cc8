"""`r2p topic hz`, `bw` and `delay`: measure a topic, without decoding it unless its type is stated.

Each reports once a second on the last `--window` messages. What is measured, and where, is kept apart: the publisher
stamps and counts its messages where the link carries that (the debug line does not), the tool counts what its own queue
lost.
"""

import asyncio
import statistics
from collections import deque
from collections.abc import Sequence
from typing import Annotated, Any, Protocol

import typer

import r2p
from r2p.names import topic_name
from r2p.tools.output import Output
from r2p.tools.session import Format, Session, Timeout
from r2p.tools.topic.watching import Count, Once, Topic, TypeName, patience, watched
from r2p.tools.types import Types

QUEUE = 4096
"""Messages that wait for the tool before the oldest are lost, counted."""

_SECOND = 1_000_000_000
_GAP = 2.0  # times the usual period: a publisher that pauses
_MEMORY = 1 / 16  # weight of a new period in the usual one
_MISSING = 65536  # sequence numbers that are remembered, in case that they still come

_STARTS = 4  # publishers that a report names
_PRECISE = 9  # decimals of seconds: ns

Window = Annotated[int, typer.Option("--window", "-w", min=2, metavar="N", help="Messages that are averaged.")]
Report = dict[str, Any]


async def hz(
    session: Session,
    topic: Topic,
    *,
    type: TypeName = None,
    window: Window = 1000,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Measure a topic's rate, and what is lost.

    Reports once a second. Periods (s) are the publisher's where it stamps its messages, else those of reception; `gaps`
    are pauses of the publisher; `lost_on_way` is known where messages are numbered. -n and --once count reports.
    """
    await _measure(session, topic, type, _Rate(window), 1 if once else count, timeout, Output(format))


async def bw(
    session: Session,
    topic: Topic,
    *,
    type: TypeName = None,
    window: Window = 1000,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Measure a topic's bandwidth.

    Reports bytes of payload, once a second. -n and --once count reports.
    """
    await _measure(session, topic, type, _Bandwidth(window), 1 if once else count, timeout, Output(format))


async def delay(
    session: Session,
    topic: Topic,
    *,
    type: TypeName = None,
    window: Window = 1000,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Measure how long messages take.

    Reports the time from publish() to this tool, once a second. Needs a link that carries stamps, and clocks that
    agree. -n and --once count reports.
    """
    await _measure(session, topic, type, _Delay(window), 1 if once else count, timeout, Output(format))


class _Meter(Protocol):
    """What is measured."""

    def note(self, sample: r2p.Sample, now: int) -> None:
        """A message was read at `now` (UTC ns). Raises r2p.Error if it can't be measured."""

    def report(self, lost: int) -> tuple[Report, str] | None:
        """The record, and its form for people; None: too little is known. `lost` counts what the tool itself lost."""

    def begin_again(self) -> None:
        """After a silence: what is averaged begins with the next message; what is counted goes on."""


async def _measure(
    session: Session,
    topic: str,
    given: str | None,
    meter: _Meter,
    reports: int | None,
    timeout: float | None,
    output: Output,
) -> None:
    cls = Types(session.settings).stated(topic_name(topic), given)
    subscriber: r2p.Subscriber[Any] = session.node.subscribe(topic, cls, queue=QUEUE, lossy=True)
    fresh = 0

    async def read() -> None:
        nonlocal fresh
        async for sample in watched(session, subscriber, typed=cls is not None):
            heard()
            fresh += 1
            meter.note(sample, session.node.now())

    async with output.while_read(), patience(topic, timeout) as heard, asyncio.TaskGroup() as tasks:
        reading = tasks.create_task(read())
        measured = False
        async for _ in session.node.every(1.0):
            report = meter.report(subscriber.lost) if fresh else None
            if report is not None:
                record, text = report
                await output.put({"topic": subscriber.topic} | record, text)
                reports = None if reports is None else reports - 1
                if reports == 0:
                    break
            elif measured and not fresh:
                session.say(f"no new messages of {topic}")
                meter.begin_again()
            measured, fresh = report is not None, 0
        reading.cancel()


class _Sequences:
    """Finds what one publisher's sequence numbers leave out. A number that comes late is not missing any more."""

    def __init__(self) -> None:
        self.last = 0
        self._missing: set[int] = set()
        self._forgotten = 0

    @property
    def missing(self) -> int:
        return self._forgotten + len(self._missing)

    def note(self, number: int) -> bool:
        """Whether it follows the last one."""
        last, self.last = self.last, max(self.last, number)
        if number <= last:
            self._missing.discard(number)
            if number == 1:  # the publisher started again
                self.last = 1
            return False
        gap = number - last - 1 if last else 0
        if gap + len(self._missing) > _MISSING:
            self._forgotten += gap
        else:
            self._missing.update(range(number - gap, number))
        return not gap and last > 0


class _Rate:
    """Rate, periods, gaps and losses."""

    def __init__(self, window: int) -> None:
        self._arrivals: deque[int] = deque(maxlen=window)
        self._periods: deque[float] = deque(maxlen=window)
        self._sequences: dict[r2p.Source, _Sequences] = {}
        self._stamps: dict[r2p.Source, int] = {}
        self._silent: set[r2p.Source] = set()
        self._numbered = False
        self._stamped = False
        self._gaps = 0
        self._usual = 0.0

    def note(self, sample: r2p.Sample, now: int) -> None:
        source = sample.source
        self._arrivals.append(now if sample.stamped else sample.stamp)
        self._stamped = sample.stamped
        follows = source in self._stamps
        if sample.sequence:
            self._numbered = True
            follows = self._sequences.setdefault(source, _Sequences()).note(sample.sequence)
        if follows:
            self._note_period((sample.stamp - self._stamps[source]) / _SECOND, source)
        self._stamps[source] = sample.stamp

    def begin_again(self) -> None:
        self._arrivals.clear()
        self._periods.clear()
        self._silent.update(self._stamps)

    def _note_period(self, period: float, source: r2p.Source) -> None:
        if self._stamped and self._usual and period > _GAP * self._usual:
            self._gaps += 1
        if source in self._silent:
            self._silent.remove(source)
            return
        self._usual += (period - self._usual) * (_MEMORY if self._periods else 1.0)
        self._periods.append(period)

    def report(self, lost: int) -> tuple[Report, str] | None:
        rate = _per_second(self._arrivals, len(self._arrivals) - 1)
        if rate is None or not self._periods:
            return None
        missing = sum(each.missing for each in self._sequences.values())
        on_way = max(0, missing - lost) if self._numbered else None
        record = {
            "rate": round(rate, 3),
            **_spread(self._periods),
            "window": len(self._arrivals),
            "gaps": self._gaps if self._stamped else None,
            "lost_on_way": on_way,
            "lost_here": lost,
            "stamps": "sender" if self._stamped else "reception",
        }
        known = f"{self._gaps} gaps at the publisher, " if self._stamped else ""
        way = "losses on the way unknown" if on_way is None else f"{on_way} lost on the way"
        text = f"{rate:.2f} Hz, period {_spread_text(record)}, {known}{way}, {lost} lost here"
        return record, text


class _Bandwidth:
    """Bytes of payload and messages a second."""

    def __init__(self, window: int) -> None:
        self._arrivals: deque[int] = deque(maxlen=window)
        self._sizes: deque[int] = deque(maxlen=window)

    def note(self, sample: r2p.Sample, now: int) -> None:
        self._arrivals.append(now if sample.stamped else sample.stamp)
        self._sizes.append(len(sample.data))

    def begin_again(self) -> None:
        self._arrivals.clear()
        self._sizes.clear()

    def report(self, lost: int) -> tuple[Report, str] | None:
        total = sum(self._sizes) - self._sizes[0] if self._sizes else 0
        bandwidth = _per_second(self._arrivals, total)
        rate = _per_second(self._arrivals, len(self._arrivals) - 1)
        if bandwidth is None or rate is None:
            return None
        record = {
            "bytes_per_second": round(bandwidth, 3),
            "messages_per_second": round(rate, 3),
            "min": min(self._sizes),
            "mean": round(statistics.fmean(self._sizes), 3),
            "max": max(self._sizes),
            "window": len(self._sizes),
            "lost_here": lost,
        }
        sizes = f"{record['min']} to {record['max']}" if record["min"] != record["max"] else f"{record['min']}"
        text = f"{_bytes(bandwidth)}/s, {rate:.2f} messages/s of {sizes} B (over {len(self._sizes)}), {lost} lost here"
        return record, text


class _Delay:
    """Time from publish() to the tool."""

    def __init__(self, window: int) -> None:
        self._delays: deque[float] = deque(maxlen=window)
        self._link = ""
        self._starts: dict[str, None] = {}
        self._error: int | None = None

    def note(self, sample: r2p.Sample, now: int) -> None:
        if not sample.stamped and not sample.hops:
            raise r2p.Error(
                f"no stamps: link {sample.source.link} does not carry when a message was published, only its reception "
                "is known here"
            )
        self._link = sample.source.link
        start = _start(sample)
        if start in self._starts or len(self._starts) < _STARTS:
            self._starts[start] = None
        self._error = None if sample.clock is None else sample.clock.error
        self._delays.append((now - sample.stamp) / _SECOND)

    def begin_again(self) -> None:
        self._delays.clear()

    def report(self, lost: int) -> tuple[Report, str] | None:
        if not self._delays:
            return None
        here = self._link.partition(":")[0] in {"", "memory"}
        clocks = "one clock" if here else "clocks not compared"
        record = {
            "mean": round(statistics.fmean(self._delays), _PRECISE),
            **_spread(self._delays),
            "window": len(self._delays),
            "from": " or ".join(self._starts),
            "to": "this tool",
            "clocks": clocks,
            "lost_here": lost,
        }
        text = f"{_ms(record['mean'])}, {_spread_text(record)}; from {record['from']} to {record['to']}, {clocks}"
        if self._error is not None:
            record["clock_error"] = self._error / _SECOND
            text += f"; network time is UTC within +-{_ms(self._error / _SECOND)}"
        return record, text


def _start(sample: r2p.Sample) -> str:
    """The instant that a sample's stamp tells."""
    if sample.stamped:
        return f"publish() in {sample.source}"
    where = "arrival at the first gateway" if sample.clock is None else "first frame on the bus"
    return f"{sample.source}'s {where}"


def _per_second(arrivals: Sequence[int], amount: int) -> float | None:
    """Amount by time between first and last; None if no time has passed."""
    span = (arrivals[-1] - arrivals[0]) / _SECOND if arrivals else 0.0
    return amount / span if span > 0 else None


def _spread(values: Sequence[float]) -> Report:
    return {
        "min": round(min(values), _PRECISE),
        "max": round(max(values), _PRECISE),
        "std": round(statistics.pstdev(values), _PRECISE),
    }


def _spread_text(record: Report) -> str:
    spread = f"{_ms(record['min'])} to {_ms(record['max'])}, std {_ms(record['std'])}"
    return f"{spread} (over {record['window']})"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3f} ms"


def _bytes(count: float) -> str:
    for unit in ("B", "kB"):
        if count < 1000:
            return f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} MB"
