"""`r2p demo`: r2p at work on one computer, with emulated hardware and real links.

`r2p demo` shows a whole robot, Triskar2: seven modules on a simulated RTCAN bus, and a PC that drives it along a square
through the robot's gateway (`r2p.tools.sim`). `r2p demo line` starts two modules with the firmware of 2014, IMU1
on a TCP connection and MOTOR1 on a pseudo terminal, as on a serial cable, and a module PC1 that talks to both over the
debug line (`Robot`); `DemoScreen` shows what they do, live at a terminal, otherwise as lines of plain text.
"""

import contextlib
import math
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from statistics import median, quantiles
from typing import Annotated, Literal, Self

import msgspec
import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table

import r2p
from r2p.clock import clock_of
from r2p.messages import Message
from r2p.msg import Encoder, Led, StampedIMURaw9, StampedVelocity3
from r2p.sim.modules import FirmwareModule, Powered, Publishes, Subscribes
from r2p.tools.options import Quiet, Verbose, time_option
from r2p.tools.output import program
from r2p.tools.session import execute, moments, wait_until
from r2p.tools.sim.run import default_links, simulate
from r2p.tools.sim.triskar2 import Triskar2Display
from r2p.units import SECOND

_ROBOT, _LINE = 20.0, 10.0  # seconds
_WINDOW = 2 * SECOND  # of the rate
_LATENCIES = 10_000  # the newest are kept
_GRAVITY = 1000  # counts of 1 mg
_IN_FLIGHT = 1.0  # seconds to wait for messages that were sent
_REFRESH = 0.25  # seconds
_LINES = 2.0  # seconds between two rounds of lines, without a terminal

Row = tuple[str, ...]

_HEADER: Row = ("TOPIC", "LINK", "HZ", "LATENCY", "LAST VALUE", "COUNT", "LOST")
_WIDTHS = (-12, -10, 5, 12, -22, 6, 4)  # negative: to the left

_TELEOP = Path("examples", "teleop.py")
_DRIVE = "topic pub velocity_cmd x=0.2 --type Velocity3 -r 20"
_NEXT = """
Try next, in two terminals: the same robot, and {what}
  {r2p} sim triskar2 --via tcp-listen:2323
  {r2p} {drive} --via tcp:127.0.0.1:2323
Or: {r2p} demo line, and with your own robot: {r2p} doctor"""


def command(
    what: Annotated[
        Literal["robot", "line"],
        typer.Argument(
            metavar="WHAT", help="robot: on a simulated CAN bus; line: the debug line, on TCP and on a serial port."
        ),
    ] = "robot",
    duration: Annotated[
        float | None, time_option("--duration", "How long; default: 20 s (robot), 10 s (line).")
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Show r2p at work, without hardware: live for a few seconds, then a summary."""

    async def line() -> None:
        screen = DemoScreen()
        async with Robot() as robot:
            screen.print_introduction(robot)
            await screen.watch(robot, duration or _LINE)
            await robot.finish()
        screen.print_summary(robot)

    async def robot() -> None:
        await simulate(Triskar2Display, duration=duration or _ROBOT, outside=default_links(), rounds=1)
        typer.echo(_next_steps())

    # Only errors are logged: any other line would tear the display apart.
    execute(robot if what == "robot" else line, verbose=verbose, quiet=quiet + 2)


def _next_steps() -> str:
    """Return what to try next; only in a checkout there are examples."""
    keys = _TELEOP.exists()
    what = "a program that drives it by keys" if keys else "a command that drives it ahead"
    return _NEXT.format(r2p=program(), what=what, drive=f"run {_TELEOP}:keys" if keys else _DRIVE)


class TopicCounter:
    """Counts the messages of one topic, with their rate and latency; the latency is one way, or of a `round_trip`."""

    def __init__(self, topic: str, link: str, *, round_trip: bool = False) -> None:
        self.topic = topic
        self.link = link
        self.round_trip = round_trip
        self.sent = 0
        self.received = 0
        self.last: Message | None = None
        self.latencies: deque[int] = deque(maxlen=_LATENCIES)
        self._recent: deque[int] = deque()

    def add(self, now: int, message: Message, latency: int | None = None) -> None:
        """Count a message that arrived at `now` (ns), after `latency` ns."""
        self.received += 1
        self.last = message
        self._recent.append(now)
        if latency is not None:
            self.latencies.append(latency)

    def rate(self, now: int) -> float:
        """Return the messages per second over the last two seconds."""
        recent = self._recent
        while recent and recent[0] <= now - _WINDOW:
            recent.popleft()
        return (len(recent) - 1) * SECOND / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    @property
    def median(self) -> float | None:
        """The median of the latencies, in ms."""
        return median(self.latencies) / 1e6 if self.latencies else None

    @property
    def slowest(self) -> float | None:
        """The 99th percentile of the latencies, in ms."""
        if len(self.latencies) < 2:
            return self.median
        return quantiles(self.latencies, n=100, method="inclusive")[98] / 1e6


class Robot:
    """IMU1 and MOTOR1, emulated, and PC1 with its nodes, for the time of an `async with` block.

    IMU1 measures, and switches LEDs on command; MOTOR1 drives on command, and reports its velocity. Both answer with
    the content of the command, so PC1 can measure the round trip.
    """

    def __init__(self) -> None:
        self.counters = {
            counter.topic: counter
            for counter in (
                TopicCounter("imu_raw", "tcp in"),
                TopicCounter("led_cmd", "tcp out"),
                TopicCounter("leds", "tcp in", round_trip=True),
                TopicCounter("encoder", "serial in"),
                TopicCounter("velocity_cmd", "serial out"),
                TopicCounter("velocity", "serial in", round_trip=True),
            )
        }
        self.address = ""
        """The address at which IMU1 listens."""
        self.device = ""
        """MOTOR1's serial port."""
        self._blinks: dict[int, int] = {}
        self._over = False
        self._stack = contextlib.AsyncExitStack()
        self._imu = FirmwareModule(
            "IMU1",
            publishers=[Publishes("imu_raw", StampedIMURaw9, 0.02, self._measure), Publishes("leds", Led)],
            subscribers=[Subscribes("led_cmd", Led, answer=self._switch)],
        )
        self._motor = FirmwareModule(
            "MOTOR1",
            publishers=[Publishes("encoder", Encoder, 0.05, self._turn), Publishes("velocity", StampedVelocity3)],
            subscribers=[Subscribes("velocity_cmd", StampedVelocity3, answer=self._move)],
        )

    async def __aenter__(self) -> Self:
        self.clock = clock_of()
        async with contextlib.AsyncExitStack() as stack:
            host, port = await (await stack.enter_async_context(Powered(self._imu))).listen()
            self.address = f"{host}:{port}"
            self.device = (await stack.enter_async_context(Powered(self._motor))).open_pty()
            links = [f"tcp:{self.address}", f"serial:{self.device}"]
            pc = await stack.enter_async_context(r2p.Module("PC1", via=links))
            for node in (self._drive, self._blink, self._watch):
                pc.start(node, name=node.__name__.strip("_"))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self._stack.aclose()

    async def finish(self) -> None:
        """Stop sending, and wait for messages in flight."""
        self._over = True
        await wait_until(lambda: all(each.received == each.sent for each in self.updated_counters()), _IN_FLIGHT)

    def updated_counters(self) -> Iterator[TopicCounter]:
        """Yield the counters, with what was sent so far."""
        for counter in self.counters.values():
            sender = self._imu if counter.link.startswith("tcp") else self._motor
            if counter.topic in sender.sent:
                counter.sent = sender.sent[counter.topic]
            yield counter

    # The emulated modules

    def _measure(self, time: int) -> StampedIMURaw9 | None:
        if self._over:
            return None
        angle = 0.2 * math.sin(time / SECOND)
        return StampedIMURaw9(
            r2p.Timestamp.from_ns(self.clock.now()),
            acc_x=round(_GRAVITY * math.sin(angle)),
            acc_z=round(_GRAVITY * math.cos(angle)),
        )

    def _turn(self, time: int) -> Encoder | None:
        if self._over:
            return None
        return Encoder(0.1 * math.sin(time / SECOND))

    def _switch(self, led: Led) -> list[tuple[str, r2p.Message]]:
        now = self.clock.now()
        self.counters["led_cmd"].add(now, led, now - self._blinks[led.led])
        return [("leds", led)]

    def _move(self, command: StampedVelocity3) -> list[tuple[str, r2p.Message]]:
        now = self.clock.now()
        self.counters["velocity_cmd"].add(now, command, now - command.timestamp.ns)
        return [("velocity", command)]

    # The nodes of PC1

    async def _drive(self, node: r2p.Node) -> None:
        commands = node.advertise("velocity_cmd", StampedVelocity3, r2p.Sporadic(deadline=0.05))
        await commands.wait_subscriber()
        async for tick in node.every(0.05):
            if self._over:
                return
            stamp = r2p.Timestamp.from_ns(node.now())
            self.counters["velocity_cmd"].sent += 1
            await commands.publish(StampedVelocity3(stamp, x=0.5, w=round(math.sin(tick.due / SECOND), 2)))

    async def _blink(self, node: r2p.Node) -> None:
        commands = node.advertise("led_cmd", Led)
        await commands.wait_subscriber()
        number = 0
        async for _ in node.every(0.1):
            if self._over:
                return
            number += 1
            self._blinks[number] = node.now()
            self.counters["led_cmd"].sent += 1
            await commands.publish(Led(led=number, value=number % 2))

    async def _watch(self, node: r2p.Node) -> None:
        def measured(message: StampedIMURaw9 | StampedVelocity3, topic: str) -> None:
            now = node.now()
            self.counters[topic].add(now, message, now - message.timestamp.ns)

        def lit(led: Led) -> None:
            now = node.now()
            self.counters["leds"].add(now, led, now - self._blinks.pop(led.led))

        node.subscribe("imu_raw", StampedIMURaw9, lambda message: measured(message, "imu_raw"))
        node.subscribe("velocity", StampedVelocity3, lambda message: measured(message, "velocity"))
        node.subscribe("encoder", Encoder, lambda message: self.counters["encoder"].add(node.now(), message))
        node.subscribe("leds", Led, lit)
        while True:
            await node.spin()


class DemoScreen:
    """Standard output as the demo uses it."""

    def __init__(self) -> None:
        self.console = Console(highlight=False)
        self._sent: dict[str, int] = {}

    def print_introduction(self, robot: Robot) -> None:
        self._print(
            f"IMU1, an emulated R2P module, serves the debug line on tcp:{robot.address}",
            f"MOTOR1, another one, serves it on serial:{robot.device}",
            "PC1, in Python, talks to both. In another terminal:",
            f"  {program()} topic hz imu_raw --via tcp:{robot.address}",
            "",
        )

    async def watch(self, robot: Robot, duration: float) -> None:
        """Show the topics for `duration` seconds."""
        if not self.console.is_terminal:
            self._print(_text(_HEADER))
            async for _ in moments(duration, _LINES):
                self._print(*(_text(row) for row in self._rows(robot)))
            return
        with Live(console=self.console, auto_refresh=False) as live:
            async for _ in moments(duration, _REFRESH):
                live.update(_table(self._rows(robot)), refresh=True)

    def print_summary(self, robot: Robot) -> None:
        self._print("")
        for link, what in (("tcp", f"tcp:{robot.address}"), ("serial", f"serial:{robot.device}")):
            counters = [counter for counter in robot.updated_counters() if counter.link.startswith(link)]
            sent, received = sum(counter.sent for counter in counters), sum(counter.received for counter in counters)
            self._print(f"{what}: {sent} messages sent, {received} received, {sent - received} lost")
            self._print(*(f"  {_times(counter)}" for counter in counters if counter.latencies))
        self._print(
            "",
            "Try next, without hardware, in two terminals:",
            f"  {program()} topic pub leds --type Led led=3 value=1 -r 2 --via tcp-listen:2323",
            f"  {program()} topic echo leds --via tcp:127.0.0.1:2323",
            f"With a robot: {program()} doctor, then {program()} topic list --via serial:/dev/ttyUSB0",
        )

    def _rows(self, robot: Robot) -> list[Row]:
        """Return a row for each topic. Lost: sent before the last display, and still not received."""
        rows: list[Row] = []
        for counter in robot.updated_counters():
            lost = max(0, self._sent.get(counter.topic, 0) - counter.received)
            self._sent[counter.topic] = counter.sent
            rate = f"{counter.rate(robot.clock.now()):.1f}"
            value, received = _value(counter.last), str(counter.received)
            rows.append((counter.topic, counter.link, rate, _latency(counter), value, received, str(lost)))
        return rows

    def _print(self, *lines: str) -> None:
        for line in lines:
            self.console.print(line, markup=False, soft_wrap=True)


def _table(rows: list[Row]) -> Table:
    table = Table(box=None, pad_edge=False, collapse_padding=True, header_style="bold")
    for name, width in zip(_HEADER, _WIDTHS, strict=True):
        table.add_column(name, justify="right" if width > 0 else "left", min_width=abs(width), no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _text(row: Row) -> str:
    cells = (cell.rjust(width) if width > 0 else cell.ljust(-width) for cell, width in zip(row, _WIDTHS, strict=True))
    return " ".join(cells)


def _latency(counter: TopicCounter) -> str:
    if counter.median is None:
        return ""
    return f"{counter.median:.2f} ms" + (" rtt" if counter.round_trip else "    ")


def _value(message: Message | None) -> str:
    """Return the fields without the timestamp; if they are too long, without those that are zero."""
    if message is None:
        return "nothing yet"
    fields = {name: value for name, value in msgspec.structs.asdict(message).items() if name != "timestamp"}
    texts = [f"{name}={value:.3g}" for name, value in fields.items()]
    if len(" ".join(texts)) > abs(_WIDTHS[4]):
        texts = [text for text, value in zip(texts, fields.values(), strict=True) if value]
    return " ".join(texts)


def _times(counter: TopicCounter) -> str:
    what = "there and back" if counter.round_trip else "one way"
    return f"{counter.topic:<12} {what}: {counter.median:.2f} ms (median), {counter.slowest:.2f} ms (99 %)"
