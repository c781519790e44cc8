"""Options that several commands share, and the parsers of their values.

Each is a type for a parameter of a command, as Typer reads it: `async def echo(session, *, timeout: Timeout = None)`.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import r2p
from r2p.bridge import ClassOf
from r2p.bridge.options import is_topic_pattern
from r2p.clock import LONGEST, SHORTEST
from r2p.names import topic_name
from r2p.tools.config import UsageError
from r2p.transports.url import duration

CLASS_NAMES = {
    r2p.PublisherClass.NON_REAL_TIME: "nrt",
    r2p.PublisherClass.SPORADIC: "sporadic",
    r2p.PublisherClass.PERIODIC: "periodic",
}
"""The publisher classes as --class names them."""


def seconds(text: str) -> float:
    """Parse a duration that a clock can count: "10ms", "20us", or seconds."""
    try:
        value = duration(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    if not SHORTEST <= value <= LONGEST:
        raise typer.BadParameter(f"{text!r}: the time must be from {SHORTEST:g} to {LONGEST:g} s")
    return value


def long_seconds(text: str) -> float:
    """Parse a duration that may have minutes and hours: "90", "500ms", "10m", "2h"."""
    unit = {"m": 60.0, "h": 3600.0}.get(text.strip()[-1:])
    return seconds(text) if unit is None else seconds(text.strip()[:-1]) * unit


def byte_size(text: str) -> int:
    """Parse a number of bytes: "4096", "500k", "1.5G" (powers of 1000), "64KiB" (powers of 1024)."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([kKMGT]?)(i?)B?", text.strip())
    if match is None or (match[3] and not match[2]):
        raise typer.BadParameter(f"{text!r} is not a size: write 500M, 1.5G or 64KiB")
    power = "kMGT".index(match[2].replace("K", "k")) + 1 if match[2] else 0
    factor: int = (1024 if match[3] else 1000) ** power
    return round(float(match[1]) * factor)


def class_choice(text: str) -> ClassOf:
    """Parse `nrt`, `periodic:10ms` or `sporadic:20ms`."""
    name, _, time = text.partition(":")
    by_name = {name: publisher_class for publisher_class, name in CLASS_NAMES.items()}
    if name not in by_name or (name == "nrt") == bool(time):
        raise typer.BadParameter(f"{text!r}: write nrt, periodic:10ms or sporadic:20ms")
    return ClassOf(by_name[name], seconds(time) if time else 0.0)


def time_option(name: str, help: str) -> Any:
    """Return an option with a duration in seconds."""
    return typer.Option(name, parser=seconds, metavar="TIME", help=help)


def valid_topic(text: str) -> str:
    """Parse the name of a topic."""
    try:
        return topic_name(text)
    except r2p.InvalidName as error:
        raise typer.BadParameter(str(error)) from error


def hertz(text: str) -> float:
    """Parse a rate in Hz whose period a clock can count."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1 / LONGEST <= value <= 1 / SHORTEST:
        raise typer.BadParameter(f"{text!r}: the rate must be a number from {1 / LONGEST:g} to {1 / SHORTEST:g} (Hz)")
    return value


Via = Annotated[
    list[str] | None,
    typer.Option("--via", metavar="URL", help="How to join: tcp:HOST:PORT, serial:DEVICE, ... (repeatable)."),
]
ParamsFile = Annotated[
    Path | None,
    typer.Option("--params-file", metavar="FILE", help="Save parameters to this file, and start with what it has."),
]
Params = Annotated[
    list[Path] | None,
    typer.Option("--params", metavar="FILE", help="Start with [params.MODULE.node] of this file (repeatable)."),
]
Param = Annotated[
    list[str] | None,
    typer.Option("--param", metavar="[NODE.]NAME=VALUE", help="Start with this value of a parameter (repeatable)."),
]
Verbose = Annotated[int, typer.Option("--verbose", "-v", count=True, show_default=False, help="Print more.")]
Quiet = Annotated[int, typer.Option("--quiet", "-q", count=True, show_default=False, help="Print less on stderr.")]
Format = Annotated[
    Literal["yaml", "json", "csv"] | None,
    typer.Option("--format", help="Output format; default: text at a terminal, JSON lines in a pipe."),
]
Timeout = Annotated[
    float | None, time_option("--timeout", "Give up (exit code 3) when nothing arrives for this long: 2, 500ms.")
]
Wait = Annotated[float | None, time_option("--wait", "Listen for this long; firmware announces one topic every 0.5 s.")]
Count = Annotated[int | None, typer.Option("--count", "-n", min=1, metavar="N", help="End after N.")]
Once = Annotated[bool, typer.Option("--once", help="End after one.")]
All = Annotated[bool, typer.Option("--all", "-a", help="Include tools, whose names begin with _.")]
Rate: Any = Annotated[
    float | None, typer.Option("--rate", "-r", parser=hertz, metavar="HZ", help="Messages per second; default: 1.")
]


def topic_pattern(text: str, option: str) -> str:
    """Return the name of a topic, or a pattern for names. Raises UsageError."""
    if not is_topic_pattern(text):
        raise UsageError(f"{option}: no topic can match {text!r}: write a name, or a pattern such as enc*")
    return text


def topic_pairs(given: list[str] | None, option: str, form: str) -> Iterator[tuple[str, str]]:
    """Yield the two parts of each TOPIC=VALUE; topics may be written as in ROS, `/scan`. Raises UsageError."""
    for text in given or ():
        topic, equals, value = text.partition("=")
        if not (topic and equals and value):
            raise UsageError(f"{option} {text}: write it as {form}")
        yield topic_pattern(topic.removeprefix("/"), option), value


def parse_remap(remap: Iterable[str]) -> dict[str, str]:
    """Return the other names of topics in OLD:=NEW. Raises UsageError."""
    names: dict[str, str] = {}
    for each in remap:
        old, found, new = each.partition(":=")
        if not found:
            raise UsageError(f"--remap {each}: write it as OLD:=NEW, for example encoder:=encoder1")
        topic, other = topic_name(old), topic_name(new)
        if names.setdefault(topic, other) != other:
            raise UsageError(f"--remap renames {topic} twice, to {names[topic]} and to {other}: leave out one of them")
    return names
