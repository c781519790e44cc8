"""`r2p bus dump`: print every frame of a bus, decoded."""

from typing import Annotated

import typer

from r2p.bus import FrameKind, SeenFrame
from r2p.names import topic_name
from r2p.tools.bus.load import listen
from r2p.tools.options import Count, Format, Quiet, Timeout, Verbose, Via
from r2p.tools.output import Output
from r2p.tools.session import execute, patience
from r2p.units import SECOND

Kinds = Annotated[
    list[FrameKind] | None, typer.Option("--kind", help="Only frames of this kind (repeatable).", show_default=False)
]
OnlyTopic = Annotated[
    list[str] | None, typer.Option("--topic", metavar="TOPIC", help="Only frames of this topic (repeatable).")
]


def dump(
    kind: Kinds = None,
    topic: OnlyTopic = None,
    count: Count = None,
    timeout: Timeout = None,
    format: Format = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Print the frames on a CAN bus: time, slot, kind, topic, module, laxity, fragment, data. Sends nothing.

    Topics and modules appear as numbers until they have announced their names.
    """
    kinds = set(kind or FrameKind)

    async def main() -> None:
        topics = {topic_name(name) for name in topic or ()}
        output = Output(format)
        printed = 0
        async with output.while_read(), listen(via) as bus, patience("the bus", timeout) as received:
            async for seen in bus:
                if seen.kind in kinds and (not topics or seen.topic in topics):
                    received()
                    await output.put(record(seen, bus.since), line(seen, bus.since))
                    printed += 1
                    if printed == count:
                        return

    execute(main, verbose=verbose, quiet=quiet)


def record(seen: SeenFrame, since: int) -> dict[str, object]:
    """Return a frame as a record; `time` is the end of the frame, in s since the command started to listen."""
    return {
        "time": round((seen.stamp - since) / SECOND, 9),
        "id": f"0x{seen.frame.id:08X}",
        "kind": seen.kind.value,
        "topic": seen.topic,
        "module": seen.module,
        "laxity": seen.laxity,
        "left": seen.left,
        "fragments": seen.fragments,
        "cycle": seen.cycle,
        "slot": seen.slot,
        "bits": seen.bits,
        "data": seen.frame.data.hex(),
        "text": seen.text,
    }


def line(seen: SeenFrame, since: int) -> str:
    """Return a frame as a line of text."""
    slot = "" if seen.slot is None else f"{seen.slot:2}"
    if seen.fragments is not None:
        part = f"{seen.fragments - seen.left}/{seen.fragments}"
    else:
        part = f"-{seen.left}" if seen.left else ""
    return (
        f"{(seen.stamp - since) / SECOND:11.6f} {slot:>2} {seen.kind.value:10} {seen.topic:16} {seen.module:7} "
        f"{seen.laxity:2} {part:>5}  {seen.frame.data.hex():16}  {seen.text}"
    ).rstrip()
