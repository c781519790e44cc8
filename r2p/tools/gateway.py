"""`r2p gateway`: join links to one network, and show what passes.

The command turns options into `BridgeOptions`. Once a second `_report` reads the gateway's counters, publishes them,
and shows them: as a table on a terminal, as records with --format, and otherwise as a log line each minute.
"""

import asyncio
import contextlib
import logging
import re
import shutil
import socket
from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.bridge import BridgeOptions, GatewayStatistics
from r2p.bridge.options import PREFIX_ON, check_prefix, is_link, parse_rule
from r2p.msg import GatewayStatus
from r2p.names import module_name_from, topic_alias
from r2p.tools import ros_gateway
from r2p.tools.options import Format, Via, class_choice, hertz, topic_pairs, topic_pattern
from r2p.tools.output import Output, aligned
from r2p.tools.session import Settings, UsageError, check_urls, service, settings
from r2p.transports.url import ROS

logger = logging.getLogger("r2p.gateway")

TOPIC = "gateway"
"""The topic of a gateway's counters, as GatewayStatus."""

_LINES = {"tcp", "tcp-listen", "serial"}
"""Schemes of debug lines, which do not carry the class of a message."""

_ROWS = 30  # routes that the table on a terminal shows at most
_SUMMARY = 60  # seconds between two log lines, where there is no terminal

_Rules = list[str] | None


_Name = Annotated[
    str | None,
    typer.Option("--name", "--module", metavar="NAME", help="The gateway's module name; default: GW_ and host."),
]
_Allow = Annotated[
    _Rules, typer.Option(metavar="TOPIC[@FROM[>TO]]", help="Forward only these topics; quote patterns (repeatable).")
]
_Deny = Annotated[_Rules, typer.Option(metavar="TOPIC[@FROM[>TO]]", help="Do not forward these topics (repeatable).")]
_RateLimit = Annotated[_Rules, typer.Option(metavar="TOPIC=HZ", help="At most HZ messages per second (repeatable).")]
_ReadOnly = Annotated[
    _Rules, typer.Option(metavar="LINK", help="Forward nothing onto this link or kind of link (repeatable).")
]
_Prefix = Annotated[str, typer.Option(metavar="robot1/", help="Prefix of the robot's topics on the network.")]
_PrefixOn = Annotated[
    _Rules, typer.Option(metavar="LINK", help="Links where the prefix applies; default: zenoh and ROS (repeatable).")
]
_Class = Annotated[
    _Rules,
    typer.Option(
        "--class",
        metavar="TOPIC=CLASS",
        help="Class of messages from a debug line: nrt, periodic:10ms or sporadic:20ms (repeatable).",
    ),
]
_Reserve = Annotated[_Rules, typer.Option(metavar="TOPIC", help="Give this topic its own slots on RTCAN (repeatable).")]
_AllowControl = Annotated[
    bool, typer.Option("--allow-control", help="Let REBOOT, BOOTLOAD, changes and loader topics in from IP links.")
]


@service
async def command(
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
    type: ros_gateway.Type = None,
    ros_type: ros_gateway.RosType = None,
    ros_nodes: ros_gateway.RosNodes = False,
    qos: ros_gateway.Qos = None,
    format: Format = None,
) -> None:
    """Join two or more links to one network, until Ctrl-C or SIGTERM.

    Topics are forwarded where they have subscribers. LINK is a name as in the log, or a kind: rtcan, tcp, serial,
    zenoh.
    """
    chosen = settings(via)
    if len(chosen.via) < 2 and not any(url.startswith("tcp-listen:") for url in chosen.via):
        raise UsageError("a gateway needs at least two links, as in --via rtcan:can0 --via zenoh:")
    check_urls(chosen.via, chosen.via_source)
    if len(set(chosen.via)) < len(chosen.via):
        raise UsageError("the same link is given twice: a gateway joins different networks")
    options = BridgeOptions(
        allow=_rules(allow, "--allow", chosen.via),
        deny=_rules(deny, "--deny", chosen.via),
        rate_limit={topic: hertz(value) for topic, value in topic_pairs(rate_limit, "--rate-limit", "TOPIC=HZ")},
        read_only=_links(read_only, "--read-only", chosen.via),
        prefix=_prefix(prefix),
        prefix_on=_links(prefix_on, "--prefix-on", chosen.via) or PREFIX_ON,
        classes={topic: class_choice(value) for topic, value in topic_pairs(class_, "--class", "TOPIC=CLASS")},
        reserve=tuple(topic_pattern(each, "--reserve") for each in reserve or ()),
        allow_control=allow_control,
    )
    _check_effect(options, chosen.via)
    links = ros_gateway.open_links(chosen, ros_gateway.RosGatewayOptions(type, ros_type, qos, ros_nodes))
    own = name or chosen.module or f"GW_{module_name_from(socket.gethostname())[:4]}"
    await serve(own, chosen, options, Output(format), links, quiet=format is None)


async def serve(
    name: str,
    settings: Settings,
    options: BridgeOptions,
    output: Output,
    links: list[Any] | None = None,
    *,
    quiet: bool = False,
) -> None:
    """Run a gateway on the links of `settings`, or on these ones, until cancelled.

    `quiet`: print nothing where there is no terminal.
    """
    async with r2p.Module(name, via=links or settings.via, aliases=settings.aliases, bridge=options) as module:
        logger.info("gateway %s joins %s; Ctrl-C ends it", name, ", ".join(settings.via))
        module.start(_report, module, None if quiet and output.format != "text" else output, name="gateway")
        await module.wait()


def _rules(given: _Rules, option: str, via: list[str]) -> tuple[str, ...]:
    for text in given or ():
        try:
            parsed = parse_rule(text)
        except r2p.Error as error:
            raise UsageError(f"{option} {error}") from error
        _links([parsed.source, parsed.target], option, via)
    return tuple(given or ())


def _links(given: _Rules, option: str, via: list[str]) -> tuple[str, ...]:
    """Check patterns for links: one that matches none of them would protect nothing, so it is an error."""
    for pattern in given or ():
        if not any(_may_match(pattern, url) for url in via):
            names = ", ".join(_link_name(url) for url in via)
            hint = "; the links to clients of a tcp-listen: are tcp:ADDRESS:PORT, so give tcp"
            served = hint if any(url.startswith("tcp-listen") for url in via) else ""
            raise UsageError(f"{option}: {pattern!r} matches none of the links {names}{served}")
    return tuple(given or ())


def _check_effect(options: BridgeOptions, via: list[str]) -> None:
    """Raise UsageError for an option that has no effect on any of the links."""
    kinds = {url.partition(":")[0] for url in via}
    if options.prefix and not any(_may_match(each, url) for each in options.prefix_on for url in via):
        raise UsageError(
            f"--prefix {options.prefix} is for links to zenoh and ROS, and there is none: choose with --prefix-on LINK"
        )
    if options.prefix_on != PREFIX_ON and not options.prefix:
        raise UsageError(f"--prefix-on {options.prefix_on[0]} needs a --prefix, such as robot1/")
    if options.reserve and kinds <= {*_LINES, "zenoh", "memory", *ROS}:
        raise UsageError("--reserve is for slots on RTCAN, and there is no such link: add --via rtcan:can0")
    if options.classes and kinds.isdisjoint(_LINES):
        raise UsageError(f"--class is for debug lines, and there is none: the links are {', '.join(via)}")


def _may_match(pattern: str, url: str) -> bool:
    """Return whether a link of this URL can have such a name; that of a server's client is known only later."""
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
        raise UsageError(f"--prefix: {error}") from error


class Row(msgspec.Struct, frozen=True):
    """One line of the table: a link (`topic` and `target` are empty), or a topic and its route.

    `not_carried` has topics that a link does not carry, and why: those that are not on ROS.
    """

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
    not_carried: dict[str, str] = {}

    def status(self) -> GatewayStatus:
        """Return the line as a message."""
        return GatewayStatus(
            topic=topic_alias(self.topic),
            source=self.source[:24],
            target=self.target[:24],
            state=self.state,
            forwarded=self.forwarded,
            dropped=sum(self.dropped.values()),
            rate=self.rate,
        )

    def cells(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the cells of the line; `names` are short names of links."""
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


class RateCounter:
    """Turns the gateway's counters into rates."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str, str], int] = {}
        self._at = 0

    def rows(self, statistics: GatewayStatistics, now: int) -> list[Row]:
        """Return the links, and the routes on which messages were forwarded or dropped; `now` in ns."""
        since = (now - self._at) / 1e9
        last, self._last, self._at = self._last, {}, now
        rows = [
            Row(
                *("", each.link, "", each.state, each.gateways, 0.0, 0, each.dropped, each.offset, each.error),
                each.not_carried,
            )
            for each in statistics.ports
        ]
        for route in statistics.routes:
            key = (route.topic, route.source, route.target)
            self._last[key] = route.forwarded
            if route.forwarded or route.dropped:
                before = last.get(key, 0)
                new = route.forwarded - (before if before <= route.forwarded else 0)  # less: the route is a new one
                rows.append(Row(*key, "", 0, round(new / since, 3), route.forwarded, route.dropped))
        return rows


class LiveTable(logging.Handler):
    """A table that is drawn over itself, until something is logged: that is written below it."""

    def __init__(self, output: Output) -> None:
        super().__init__()
        self._output = output
        self._height = 0  # 0: there is nothing to draw over
        logging.getLogger("r2p").addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Note that something is logged."""
        self._height = 0

    def close(self) -> None:
        """Ignore what is logged from now on."""
        logging.getLogger("r2p").removeHandler(self)
        super().close()

    async def draw(self, rows: list[Row]) -> None:
        """Draw the table over the last one."""
        text = crop(table(rows), *shutil.get_terminal_size())
        over, self._height = self._height, text.count("\n") + 1
        await self._output.remark(text, over=over)


def crop(text: str, columns: int, lines: int) -> str:
    """Return as much of the text as fits a terminal: lines that wrap or scroll can't be drawn over."""
    shown = text.splitlines()
    height = max(lines - 2, 1)  # below it are a blank line and the cursor's
    if len(shown) > height:
        shown[height - 1 :] = [f"... and {len(shown) - height + 1} more lines"]
    return "".join(f"{line[:columns]}\n" for line in shown)


def _short_names(links: set[str]) -> dict[str, str]:
    """Return the kind of each link that is the only one of its kind: full names are too wide for a terminal."""
    kinds = Counter(link.partition(":")[0] for link in links)
    return {link: kind for link in links if kinds[kind := link.partition(":")[0]] == 1}


def table(rows: list[Row]) -> str:
    """Return the rows as text: links, and below them the busiest topics."""
    names = _short_names({row.source for row in rows if not row.topic})
    links = [row.cells(names) for row in rows if not row.topic]
    routes = sorted((row for row in rows if row.topic), key=lambda row: (-row.rate, row.topic))
    clocks = ["clock"] if any(each["clock"] for each in links) else []
    text = aligned(links, ["link", "state", *clocks, "dropped"])
    if routes:
        columns = ["topic", "from", "to", "rate", "forwarded", "dropped"]
        text += "\n" + aligned([row.cells(names) for row in routes[:_ROWS]], columns)
    text += "".join(_not_carried(row, names) for row in rows if row.not_carried)
    if len(routes) > _ROWS:
        text += f"... and {len(routes) - _ROWS} more\n"
    return text


def _not_carried(row: Row, names: Mapping[str, str]) -> str:
    """Say which topics a link does not carry, a line for each reason."""
    by_reason: dict[str, list[str]] = {}
    for topic, reason in sorted(row.not_carried.items()):
        by_reason.setdefault(reason, []).append(topic)
    link = names.get(row.source, row.source)
    lines = (f"not on {link}: {', '.join(topics)}: {reason}" for reason, topics in by_reason.items())
    return "\n" + "\n".join(lines) + "\n"


async def _report(node: r2p.Node, module: r2p.Module, output: Output | None) -> None:
    """Show and publish once a second what passes."""
    status = node.advertise(TOPIC, GatewayStatus)
    rates, seconds = RateCounter(), 0
    live = LiveTable(output) if output is not None and output.format == "text" else None
    with contextlib.nullcontext() if live is None else contextlib.closing(live):
        async for _ in node.every(1.0):
            rows = rates.rows(module.gateway_statistics(), node.now())
            seconds += 1
            if status.subscribers:
                for row in rows:
                    status.publish_nowait(row.status())
                    await asyncio.sleep(0)  # a big network has hundreds of rows: let the gateway forward in between
            if live is not None:
                await live.draw(rows)
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
