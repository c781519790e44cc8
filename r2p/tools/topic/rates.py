"""`r2p topic hz`, `bw` and `delay`: measure a topic, without decoding it unless its type is given.

Each reports once a second on the last `--window` messages. Reports say where a number comes from: the publisher stamps
and numbers its messages if the link carries that (the debug line does not), and this tool counts what its own queue
lost.
"""

import asyncio
import statistics
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from typing import Annotated, Any

import typer

import r2p
from r2p.names import topic_name
from r2p.tools.options import Count, Format, Once, Timeout
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, patience
from r2p.tools.topic.watching import Topic, TypeName, advice, received_samples, while_publishers_fit
from r2p.tools.types import Types
from r2p.units import SECOND

QUEUE = 4096
"""Messages that wait for this tool; beyond that the oldest are lost, and counted."""

_GAP = 2.0  # times the usual period: beyond that the publisher has paused
_SMOOTHING = 1 / 16  # weight of a new period in the usual one, so that one gap hardly moves it
_MISSING_MAX = 65536  # missing sequence numbers that are remembered: they may still arrive
_ORIGINS = 4  # publishers that a report names
_DIGITS = 9  # decimals of seconds: ns
Window = Annotated[int, typer.Option("--window", "-w", min=2, metavar="N", help="Messages to average over.")]
Report = dict[str, Any]


class _Meter(ABC):
    """One kind of measurement, over the last `window` messages. Its docstring is the help of its command."""

    def __init__(self, window: int) -> None:
        self.fresh = 0
        """Messages since the last report."""
        self._arrivals: deque[int] = deque(maxlen=window)  # UTC ns

    def add(self, sample: r2p.Sample, now: int) -> None:
        """Measure a message that was received at `now` (UTC ns). Raises r2p.Error if it can't be measured."""
        self.fresh += 1
        self._arrivals.append(now if sample.stamped else sample.stamp)

    @abstractmethod
    def report(self, lost: int) -> tuple[Report, str] | None:
        """Return the record and its text, or None if too little is known. `lost`: messages that this tool lost."""

    def restart(self) -> None:
        """Start new averages with the next message, after a silence; counters go on."""
        self._arrivals.clear()

    @property
    def alone(self) -> bool:
        """Return whether there is only one message since the start or the last silence."""
        return len(self._arrivals) == 1

    def is_silent(self, now: int) -> bool:
        """Return whether nothing has come for much longer than usual, and for at least a second (`now`: UTC ns)."""
        if len(self._arrivals) < 2:
            return False
        usual = (self._arrivals[-1] - self._arrivals[0]) / (len(self._arrivals) - 1)
        return now - self._arrivals[-1] >= max(SECOND, _GAP * usual)

    def _per_second(self, amount: int) -> float | None:
        """Return the amount per second between the first and the last arrival; None if no time has passed."""
        span = (self._arrivals[-1] - self._arrivals[0]) / SECOND if self._arrivals else 0.0
        return amount / span if span > 0 else None


def _command(name: str, kind: type[_Meter]) -> Callable[..., Coroutine[Any, Any, None]]:
    """Return the command for a kind of measurement, whose docstring is the help."""

    async def command(
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
        cls = Types(session.settings).stated(topic_name(topic), type)
        subscriber: r2p.Subscriber[Any] = session.node.subscribe(topic, cls, queue=QUEUE, lossy=True)
        meter, output = kind(window), Output(format)

        async def read() -> None:
            async for sample in received_samples(session, subscriber, typed=cls is not None):
                received()
                meter.add(sample, session.node.now())

        async with (
            output.while_read(),
            patience(f"nothing received on {topic}", timeout, advice(session, [subscriber.topic], timeout)) as received,
            while_publishers_fit(session, subscriber, cls),
            asyncio.TaskGroup() as tasks,
        ):
            reading = tasks.create_task(read())
            await _print(session.node, subscriber, meter, output, 1 if once else count)
            reading.cancel()

    command.__name__, command.__doc__ = name, kind.__doc__
    return command


async def _print(
    node: r2p.Node, subscriber: r2p.Subscriber[Any], meter: _Meter, output: Output, count: int | None
) -> None:
    """Print a report once a second, `count` of them or without end."""
    topic, printed, waits = subscriber.topic, 0, False
    async for _ in node.every(1.0):
        report = meter.report(subscriber.lost) if meter.fresh else None
        if report is not None:
            record, text = report
            await output.put({"topic": topic} | record, text, wrap=True)
            printed += 1
            if printed == count:
                return
        elif meter.is_silent(node.now()):
            notify(f"no new messages of {topic}")
            meter.restart()
        elif meter.alone and not (meter.fresh or waits):
            waits = True
            notify(f"waiting for the second message of {topic}: one has no rate")
        meter.fresh = 0


class _Sequences:
    """Counts the gaps in the sequence numbers of one publisher. One that arrives late is not missing."""

    def __init__(self) -> None:
        self.last = 0
        self._missing: set[int] = set()
        self._forgotten = 0

    @property
    def missing(self) -> int:
        return self._forgotten + len(self._missing)

    def add(self, number: int) -> bool:
        """Note a sequence number; return whether it follows the last one."""
        last, self.last = self.last, max(self.last, number)
        if number <= last:
            self._missing.discard(number)
            if number == 1:  # the publisher was restarted
                self.last = 1
            return False
        gap = number - last - 1 if last else 0
        if gap + len(self._missing) > _MISSING_MAX:
            self._forgotten += gap
        else:
            self._missing.update(range(number - gap, number))
        return not gap and last > 0


class _Rate(_Meter):
    """Measure the rate of a topic, and losses.

    Reports once a second. Periods (s) are the publisher's if it stamps its messages, otherwise those of reception;
    `gaps` are pauses of the publisher; `lost_on_way` needs numbered messages. -n and --once count reports.
    """

    def __init__(self, window: int) -> None:
        super().__init__(window)
        self._periods: deque[float] = deque(maxlen=window)
        self._sequences: dict[r2p.Source, _Sequences] = {}
        self._stamps: dict[r2p.Source, int] = {}
        self._silent: set[r2p.Source] = set()  # their next period spans a silence, and does not count
        self._numbered = False
        self._stamped = False
        self._gaps = 0
        self._usual = 0.0

    def add(self, sample: r2p.Sample, now: int) -> None:
        source = sample.source
        super().add(sample, now)
        self._stamped = sample.stamped
        follows = source in self._stamps
        if sample.sequence:
            self._numbered = True
            follows = self._sequences.setdefault(source, _Sequences()).add(sample.sequence)
        if follows:
            self._add_period((sample.stamp - self._stamps[source]) / SECOND, source)
        self._stamps[source] = sample.stamp

    def restart(self) -> None:
        super().restart()
        self._periods.clear()
        self._silent.update(self._stamps)

    def _add_period(self, period: float, source: r2p.Source) -> None:
        if self._stamped and self._usual and period > _GAP * self._usual:
            self._gaps += 1
        if source in self._silent:
            self._silent.remove(source)
            return
        self._usual += (period - self._usual) * (_SMOOTHING if self._periods else 1.0)
        self._periods.append(period)

    def report(self, lost: int) -> tuple[Report, str] | None:
        rate = self._per_second(len(self._arrivals) - 1)
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


class _Bandwidth(_Meter):
    """Measure the bandwidth of a topic.

    Reports payload bytes once a second. -n and --once count reports.
    """

    def __init__(self, window: int) -> None:
        super().__init__(window)
        self._sizes: deque[int] = deque(maxlen=window)

    def add(self, sample: r2p.Sample, now: int) -> None:
        super().add(sample, now)
        self._sizes.append(len(sample.data))

    def restart(self) -> None:
        super().restart()
        self._sizes.clear()

    def report(self, lost: int) -> tuple[Report, str] | None:
        total = sum(self._sizes) - self._sizes[0] if self._sizes else 0
        bandwidth = self._per_second(total)
        rate = self._per_second(len(self._arrivals) - 1)
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


class _Delay(_Meter):
    """Measure how long messages take.

    Reports the time from publish() to this tool once a second. Needs a link that carries stamps, and synchronized
    clocks. -n and --once count reports.
    """

    def __init__(self, window: int) -> None:
        super().__init__(window)
        self._delays: deque[float] = deque(maxlen=window)
        self._link = ""
        self._origins: dict[str, None] = {}
        self._error: int | None = None

    def add(self, sample: r2p.Sample, now: int) -> None:
        if not sample.stamped and not sample.hops:
            raise r2p.Error(
                f"no stamps: link {sample.source.link} does not carry when a message was published, so its delay is "
                "unknown"
            )
        super().add(sample, now)
        self._link = sample.source.link
        origin = _origin(sample)
        if origin in self._origins or len(self._origins) < _ORIGINS:
            self._origins[origin] = None
        self._error = None if sample.clock is None else sample.clock.error
        self._delays.append((now - sample.stamp) / SECOND)

    def restart(self) -> None:
        super().restart()
        self._delays.clear()

    def report(self, lost: int) -> tuple[Report, str] | None:
        if not self._delays:
            return None
        here = self._link.partition(":")[0] in {"", "memory"}
        clocks = "one clock" if here else "clocks not compared"
        record = {
            "mean": round(statistics.fmean(self._delays), _DIGITS),
            **_spread(self._delays),
            "window": len(self._delays),
            "from": " or ".join(self._origins),
            "to": "this tool",
            "clocks": clocks,
            "lost_here": lost,
        }
        text = f"{_ms(record['mean'])}, {_spread_text(record)}; from {record['from']} to {record['to']}, {clocks}"
        if self._error is not None:
            record["clock_error"] = self._error / SECOND
            text += f"; network time is UTC within +-{_ms(self._error / SECOND)}"
        return record, text


def _origin(sample: r2p.Sample) -> str:
    """Describe the instant of a sample's stamp."""
    if sample.stamped:
        return f"publish() in {sample.source}"
    where = "arrival at the first gateway" if sample.clock is None else "first frame on the bus"
    return f"{sample.source}'s {where}"


def _spread(values: Sequence[float]) -> Report:
    return {
        "min": round(min(values), _DIGITS),
        "max": round(max(values), _DIGITS),
        "std": round(statistics.pstdev(values), _DIGITS),
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


hz = _command("hz", _Rate)
bw = _command("bw", _Bandwidth)
delay = _command("delay", _Delay)
