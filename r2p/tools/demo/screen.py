"""Shows the topics of the demo: as a live table at a terminal, otherwise as lines of plain text."""

import asyncio
from collections.abc import AsyncIterator

import msgspec
from rich.console import Console
from rich.live import Live
from rich.table import Table

from r2p.messages import Message
from r2p.tools.demo.robot import Robot, TopicCounter

_REFRESH = 0.25  # seconds
_LINES = 2.0  # seconds between two rounds of lines, without a terminal

Row = tuple[str, ...]

_HEADER: Row = ("TOPIC", "LINK", "HZ", "LATENCY", "LAST VALUE", "COUNT", "LOST")
_WIDTHS = (-12, -10, 5, 12, -22, 6, 4)  # negative: to the left


class DemoScreen:
    """Standard output as the demo uses it."""

    def __init__(self) -> None:
        self.console = Console(highlight=False)
        self._sent: dict[str, int] = {}

    def print_introduction(self, robot: Robot) -> None:
        self._print(
            f"IMU1, an emulated R2P module, serves the debug line on tcp:{robot.address}",
            f"MOTOR1, another one, serves it on serial:{robot.device}",
            "PC1, in Python, talks to both. Watch them from a second terminal:",
            f"  r2p topic hz imu_raw --via tcp:{robot.address}",
            "",
        )

    async def watch(self, robot: Robot, duration: float) -> None:
        """Show the topics for `duration` seconds."""
        end = asyncio.get_running_loop().time() + duration
        if not self.console.is_terminal:
            self._print(_text(_HEADER))
            async for _ in _until(end, _LINES):
                self._print(*(_text(row) for row in self._rows(robot)))
            return
        with Live(console=self.console, auto_refresh=False) as live:
            async for _ in _until(end, _REFRESH):
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
            "  r2p topic pub leds --type Led led=3 value=1 -r 2 --via tcp-listen:2323",
            "  r2p topic echo leds --via tcp:127.0.0.1:2323",
            "With a robot: r2p doctor, then r2p topic list --via serial:/dev/ttyUSB0",
        )

    def _rows(self, robot: Robot) -> list[Row]:
        """Return a row for each topic. Lost: sent before the last display, and still not received."""
        rows: list[Row] = []
        for counter in robot.updated_counters():
            lost = max(0, self._sent.get(counter.topic, 0) - counter.received)
            self._sent[counter.topic] = counter.sent
            rate = f"{counter.rate(robot.clock.now()):.1f}"
            rows.append(
                (
                    counter.topic,
                    counter.link,
                    rate,
                    _latency(counter),
                    _value(counter.last),
                    str(counter.received),
                    str(lost),
                )
            )
        return rows

    def _print(self, *lines: str) -> None:
        for line in lines:
            self.console.print(line, markup=False, soft_wrap=True)


async def _until(end: float, period: float) -> AsyncIterator[None]:
    """Yield once each period, and at the end."""
    loop = asyncio.get_running_loop()
    while (left := end - loop.time()) > 0:
        await asyncio.sleep(min(period, left))
        yield


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
