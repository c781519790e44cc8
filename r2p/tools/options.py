"""Arguments and options that the topic commands share."""

from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.tools.session import seconds, settings
from r2p.tools.types import complete_type

CLASS_NAMES = {
    r2p.PublisherClass.NON_REAL_TIME: "nrt",
    r2p.PublisherClass.SPORADIC: "sporadic",
    r2p.PublisherClass.PERIODIC: "periodic",
}
"""The three classes as --class names them."""


class ClassChoice(msgspec.Struct, frozen=True):
    """A publisher class, and its period or deadline in seconds."""

    publisher_class: r2p.PublisherClass
    time: float = 0.0


def class_choice(text: str) -> ClassChoice:
    """`nrt`, `periodic:10ms` or `sporadic:20ms`."""
    name, _, time = text.partition(":")
    by_name = {name: publisher_class for publisher_class, name in CLASS_NAMES.items()}
    if name not in by_name or (name == "nrt") == bool(time):
        raise typer.BadParameter(f"{text!r}: write nrt, periodic:10ms or sporadic:20ms")
    return ClassChoice(by_name[name], seconds(time) if time else 0.0)


def hertz(text: str) -> float:
    """A rate of more than 0 Hz."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise typer.BadParameter(f"{text!r}: a rate is a number of more than 0 Hz")
    return value


def _complete_topic(incomplete: str) -> list[str]:
    return [name for name in settings().types if name.startswith(incomplete)]


Topic = Annotated[str, typer.Argument(metavar="TOPIC", autocompletion=_complete_topic, show_default=False)]
Topics = Annotated[list[str], typer.Argument(metavar="TOPIC...", autocompletion=_complete_topic, show_default=False)]
TypeName = Annotated[
    str | None,
    typer.Option(
        "--type",
        metavar="TYPE",
        autocompletion=complete_type,
        help="package.module:Class, FILE.py:Class, or a name in r2p.msg; default: r2p.toml, then what the peer tells.",
    ),
]
Count = Annotated[int | None, typer.Option("--count", "-n", min=1, metavar="N", help="End after so many.")]
Once = Annotated[bool, typer.Option("--once", help="End after one.")]
Rate: Any = Annotated[
    float | None, typer.Option("--rate", "-r", parser=hertz, metavar="HZ", help="Messages a second; default: 1.")
]
