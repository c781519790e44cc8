"""The table of `r2p gateway`: what its links do, and what passes on each way, as rows, as text, and on a screen."""

import logging
import shutil
from collections import Counter
from collections.abc import Mapping
from typing import Any

import msgspec

from r2p.bridge import GatewayStatistics
from r2p.msg import GatewayStatus
from r2p.tools.output import Output, aligned

_ROWS = 30  # ways that the table on a terminal shows at most


class Row(msgspec.Struct, frozen=True):
    """One line of the table: a link (`topic` and `target` are empty), or a topic and its way."""

    topic: str
    source: str
    target: str
    state: str
    gateways: int
    rate: float
    forwarded: int
    dropped: dict[str, int]
    offset: int | None = None
    error: int | None = None

    def status(self) -> GatewayStatus:
        """As it is published."""
        return GatewayStatus(
            topic=self.topic[:16],
            source=self.source[:24],
            target=self.target[:24],
            state=self.state,
            forwarded=self.forwarded,
            dropped=sum(self.dropped.values()),
            rate=self.rate,
        )

    def cells(self, names: Mapping[str, str]) -> dict[str, Any]:
        """As it is shown; `names` are those of the links."""
        dropped = ", ".join(f"{count} {reason}" for reason, count in sorted(self.dropped.items()))
        if not self.topic:
            others = f" ({self.gateways} more here)" if self.gateways else ""
            clock = "" if self.error is None else f"+-{self.error / 1e3:.0f} us"
            state = "forwarding, alone" if self.state == "alone" else self.state + others
            return {"link": self.source, "state": state, "clock": clock, "dropped": dropped}
        return {
            "topic": self.topic,
            "from": names.get(self.source, self.source),
            "to": names.get(self.target, self.target),
            "rate": f"{self.rate:.1f}/s",
            "forwarded": self.forwarded,
            "dropped": dropped,
        }


class Rates:
    """Turns counters into rates."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str, str], int] = {}
        self._at = 0

    def rows(self, statistics: GatewayStatistics, now: int) -> list[Row]:
        """The links, and the ways that something has passed or was dropped on; `now` in ns."""
        since = (now - self._at) / 1e9
        last, self._last, self._at = self._last, {}, now
        rows = [
            Row("", each.link, "", each.state, each.gateways, 0.0, 0, each.dropped, each.offset, each.error)
            for each in statistics.ports
        ]
        for way in statistics.ways:
            key = (way.topic, way.source, way.target)
            self._last[key] = way.forwarded
            if way.forwarded or way.dropped:
                before = last.get(key, 0)
                new = way.forwarded - (before if before <= way.forwarded else 0)  # else the way was made anew
                rows.append(Row(*key, "", 0, round(new / since, 3), way.forwarded, way.dropped))
        return rows


class _Noticed(logging.Handler):
    """Counts what is logged: it stands between the table and the cursor."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


class Screen:
    """A table that stays in its place, until something else is written below it."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self._noticed = _Noticed()
        self._seen = 0
        self._height = 0
        logging.getLogger("r2p").addHandler(self._noticed)

    def close(self) -> None:
        """Write no more."""
        logging.getLogger("r2p").removeHandler(self._noticed)

    async def draw(self, rows: list[Row]) -> None:
        """Write the table over the last one."""
        text = fitted(table(rows), *shutil.get_terminal_size())
        over = self._height if self._noticed.count == self._seen else 0
        self._seen = self._noticed.count
        self._height = text.count("\n") + 1
        await self._output.remark(text, over=over)


def fitted(text: str, columns: int, lines: int) -> str:
    """As much as a terminal has room for: what it would wrap or scroll could not be written over."""
    shown = text.splitlines()
    room = max(lines - 2, 1)  # a blank line and the cursor's are below it
    if len(shown) > room:
        shown[room - 1 :] = [f"... and {len(shown) - room + 1} more lines"]
    return "".join(f"{line[:columns]}\n" for line in shown)


def _short(links: set[str]) -> dict[str, str]:
    """Links by their kind alone where there is only one of it: rows of full names are wider than a terminal."""
    kinds = Counter(link.partition(":")[0] for link in links)
    return {link: kind for link in links if kinds[kind := link.partition(":")[0]] == 1}


def table(rows: list[Row]) -> str:
    """The rows for people: links, and below them the busiest topics."""
    names = _short({row.source for row in rows if not row.topic})
    links = [row.cells(names) for row in rows if not row.topic]
    ways = sorted((row for row in rows if row.topic), key=lambda row: (-row.rate, row.topic))
    clocks = ["clock"] if any(each["clock"] for each in links) else []
    text = aligned(links, ["link", "state", *clocks, "dropped"])
    if ways:
        columns = ["topic", "from", "to", "rate", "forwarded", "dropped"]
        text += "\n" + aligned([row.cells(names) for row in ways[:_ROWS]], columns)
    if len(ways) > _ROWS:
        text += f"... and {len(ways) - _ROWS} more\n"
    return text
