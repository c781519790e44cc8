"""`r2p bag`: recordings of topics, CAN frames and what happened to them, in files.

`record` writes a file, and `convert` makes files of other formats of it, and it of those. `info`, `echo` and `frames`
show what is in one; `edit` has `cut` and `merge`, and `recover` makes a file whole that was cut off. `play`
publishes what was recorded, with the keys of `controls`.

Each is imported when it is called: all of them would take longer than to show what is in a recording.
"""

import importlib

import typer

from r2p.tools import session
from r2p.tools.lazy_group import Register, lazy_group


def _record(app: typer.Typer) -> None:
    from r2p.tools.bag import record

    body = session.command(app, "record", endless=lambda _given: True, check=record.check, joins=record.has_topics)
    body(record.record)


def _play(app: typer.Typer) -> None:
    from r2p.tools.bag import play

    app.command("play")(session.standalone(play.play, endless=lambda given: bool(given["loop"])))


def _alone(module: str, name: str) -> Register:
    """Return what makes a function of a module a command that joins no network."""

    def register(app: typer.Typer) -> None:
        body = getattr(importlib.import_module(f"{__name__}.{module}"), name)
        app.command(name)(session.standalone(body))

    return register


COMMANDS: dict[str, tuple[str, Register]] = {
    "record": ("Record topics into a file, until Ctrl-C.", _record),
    "play": ("Publish the messages of a recording at their times.", _play),
    "info": ("Show what is in a recording, and what was lost.", _alone("info", "info")),
    "echo": ("Print the messages of a recording, as r2p topic echo does.", _alone("echo", "echo")),
    "events": ("Print what happened: links, elections, slots, misses.", _alone("events", "events")),
    "slots": ("Print who owned which slot of an RTCAN bus, and when.", _alone("events", "slots")),
    "attachment": ("List the files in a recording, or print one of them.", _alone("attachment", "attachment")),
    "frames": ("Print the CAN frames of a recording.", _alone("frames", "frames")),
    "cut": ("Write a part of a recording into a new file.", _alone("edit", "cut")),
    "merge": ("Write several recordings into one, in the order of time.", _alone("edit", "merge")),
    "convert": ("Convert a recording into another format.", _alone("convert", "convert")),
    "recover": ("Write what can be read of a damaged recording into a new file.", _alone("recover", "recover")),
}
"""By name: the first line of help, and what imports the command."""

app = lazy_group("Record topics to a file, and play, inspect and convert it.", COMMANDS)
