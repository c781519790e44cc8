"""`r2p gateway`: joins links of any kind, and shows what passes."""

import asyncio
import logging
import re
import shutil
import socket
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.bridge import BridgeOptions, ClassOf, GatewayStatistics
from r2p.bridge.options import check_prefix, is_link, rule
from r2p.msg import GatewayStatus
from r2p.names import module_name_from
from r2p.tools.output import Output, aligned
from r2p.tools.session import Format, Quiet, Usage, Verbose, Via, check_urls, execute, settings
from r2p.tools.topic.watching import class_choice, hertz

# The table of `r2p gateway`: what its links do, and what passes on each way, as rows, as text, and on a screen.


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


class GatewayScreen:
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


# gateway


logger = logging.getLogger("r2p.gateway")

TOPIC = "gateway"
"""Where a gateway publishes its counters, as GatewayStatus."""

_SUMMARY = 60  # seconds between two lines on what has passed, where there is no terminal

_Rules = list[str] | None


_Name = Annotated[
    str | None,
    typer.Option("--name", "--module", metavar="NAME", help="The gateway's module name; default: GW_ and host."),
]
_Allow = Annotated[
    _Rules, typer.Option(metavar="TOPIC[@FROM[>TO]]", help="Forward only such topics; patterns, quoted (may repeat).")
]
_Deny = Annotated[_Rules, typer.Option(metavar="TOPIC[@FROM[>TO]]", help="Do not forward such topics (may repeat).")]
_RateLimit = Annotated[_Rules, typer.Option(metavar="TOPIC=HZ", help="Forward at most so many a second (may repeat).")]
_ReadOnly = Annotated[
    _Rules, typer.Option(metavar="LINK", help="Forward nothing onto this link, or this kind of link (may repeat).")
]
_Prefix = Annotated[
    str, typer.Option(metavar="robot1/", help="What the robot's topics are called with on the network.")
]
_PrefixOn = Annotated[
    _Rules, typer.Option(metavar="LINK", help="The links that are the network; default: zenoh (may repeat).")
]
_Class = Annotated[
    _Rules,
    typer.Option(
        "--class",
        metavar="TOPIC=CLASS",
        help="nrt, periodic:10ms or sporadic:20ms, for what a debug line brings (may repeat).",
    ),
]
_Reserve = Annotated[_Rules, typer.Option(metavar="TOPIC", help="Send it in slots of its own on RTCAN (may repeat).")]
_AllowControl = Annotated[
    bool, typer.Option("--allow-control", help="Let REBOOT, BOOTLOAD and loader topics in from IP links.")
]


def command(
    via: Via = None,
    name: _Name = None,
    allow: _Allow = None,
    deny: _Deny = None,
    rate_limit: _RateLimit = None,
    read_only: _ReadOnly = None,
    prefix: _Prefix = "",
    prefix_on: _PrefixOn = None,
    class_: _Class = None,
    reserve: _Reserve = None,
    allow_control: _AllowControl = False,
    format: Format = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Join two or more links to one network, until Ctrl-C or SIGTERM ends it.

    Topics pass where somebody wants them. Links are named as in the log, or by their kind: rtcan, tcp, serial, zenoh.
    """

    async def main() -> None:
        chosen = settings(via)
        if len(chosen.via) < 2 and not any(url.startswith("tcp-listen:") for url in chosen.via):
            raise Usage("a gateway joins two links: --via rtcan:can0 --via zenoh:")
        check_urls(chosen.via)
        if len(set(chosen.via)) < len(chosen.via):
            raise Usage("a link is given twice: it leads to the same network, so there is nothing to join")
        options = BridgeOptions(
            allow=_rules(allow, "--allow", chosen.via),
            deny=_rules(deny, "--deny", chosen.via),
            rate_limit={topic: hertz(value) for topic, value in _pairs(rate_limit, "--rate-limit", "TOPIC=HZ")},
            read_only=_links(read_only, "--read-only", chosen.via),
            prefix=_prefix(prefix),
            prefix_on=_links(prefix_on, "--prefix-on", chosen.via) or ("zenoh",),
            classes={topic: _class(value) for topic, value in _pairs(class_, "--class", "TOPIC=CLASS")},
            reserve=tuple(reserve or ()),
            allow_control=allow_control,
        )
        await serve(name or chosen.module or default_name(), chosen.via, options, Output(format), quiet=format is None)

    execute(main, verbose=verbose, quiet=quiet)


async def serve(name: str, via: list[str], options: BridgeOptions, output: Output, *, quiet: bool = False) -> None:
    """Run a gateway until cancelled. `quiet`: print nothing where there is no terminal."""
    async with r2p.Module(name, via=via, bridge=options) as module:
        logger.info("gateway %s joins %s; Ctrl-C ends it", name, ", ".join(via))
        module.start(_report, module, None if quiet and output.format != "text" else output, name="gateway")
        await module.wait()


def default_name() -> str:
    """GW_ and as much of the host's name as fits."""
    return f"GW_{module_name_from(socket.gethostname())[:4]}"


async def _report(node: r2p.Node, module: r2p.Module, output: Output | None) -> None:
    """Show and publish what passes, once a second."""
    status = node.advertise(TOPIC, GatewayStatus)
    rates = Rates()
    screen = GatewayScreen(output) if output is not None and output.format == "text" else None
    try:
        await _report_each_second(node, module, status, rates, screen, output)
    finally:
        if screen is not None:
            screen.close()


async def _report_each_second(
    node: r2p.Node,
    module: r2p.Module,
    status: r2p.Publisher[GatewayStatus],
    rates: Rates,
    screen: GatewayScreen | None,
    output: Output | None,
) -> None:
    seconds = 0
    async for _ in node.every(1.0):
        rows = rates.rows(module.gateway_statistics(), node.now())
        seconds += 1
        if status.subscribers:
            for row in rows:
                status.publish_nowait(row.status())
                await asyncio.sleep(0)
        if screen is not None:
            await screen.draw(rows)
        elif output is not None:
            for row in rows:
                await output.put(msgspec.to_builtins(row))
        elif seconds % _SUMMARY == 0:
            _summarise(rows)


def _summarise(rows: list[Row]) -> None:
    forwarded = sum(row.forwarded for row in rows)
    dropped = sum(sum(row.dropped.values()) for row in rows)
    states = ", ".join(f"{row.source} {row.state}" for row in rows if not row.topic)
    logger.info("%d messages forwarded, %d dropped so far; links: %s", forwarded, dropped, states)


def _rules(given: _Rules, option: str, via: list[str]) -> tuple[str, ...]:
    for text in given or ():
        try:
            parsed = rule(text)
        except r2p.Error as error:
            raise Usage(f"{option} {error}") from error
        _links([parsed.source, parsed.target], option, via)
    return tuple(given or ())


def _links(given: _Rules, option: str, via: list[str]) -> tuple[str, ...]:
    """Patterns for links; one that means none of them protects nothing, so it is a mistake."""
    for pattern in given or ():
        if not any(_may_mean(pattern, url) for url in via):
            names = ", ".join(_link_name(url) for url in via)
            raise Usage(f"{option}: {pattern!r} is none of the links {names}")
    return tuple(given or ())


def _may_mean(pattern: str, url: str) -> bool:
    """Whether a link of this URL can have such a name; that of a client of a server is known only when it comes."""
    name = _link_name(url)
    if name.startswith("tcp-listen"):
        return pattern.startswith("tcp:") or is_link("tcp:192.168.0.10:1024", pattern)
    return is_link(name, pattern) or pattern.startswith((f"{name}:", f"{name}#"))  # tcp:HOST has a port then


def _link_name(url: str) -> str:
    return re.split("[?,]", url)[0]


def _prefix(text: str) -> str:
    try:
        return check_prefix(text)
    except r2p.Error as error:
        raise Usage(f"--prefix: {error}") from error


def _pairs(given: _Rules, option: str, form: str) -> Iterable[tuple[str, str]]:
    for text in given or ():
        topic, equals, value = text.partition("=")
        if not (topic and equals and value):
            raise Usage(f"{option} {text}: write it as {form}")
        yield topic, value


def _class(text: str) -> ClassOf:
    choice = class_choice(text)
    return ClassOf(choice.publisher_class, choice.time)
