"""`r2p module`: who is on the network, and orders to them.

An order may be lost, so it is repeated until the module's ALIVE confirms it. None of them is an emergency stop.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from itertools import pairwise
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.codecs.management import FLAG_BOOT, FLAG_REBOOTED, FLAG_STOPPED
from r2p.names import module_path
from r2p.tools import session
from r2p.tools.output import Output
from r2p.tools.session import Format, Session, TimedOut, Timeout, Usage, Wait

TIMEOUT = 10.0
"""Seconds that an order has to be confirmed in: firmware with many topics says ALIVE that rarely."""

_FIRST_LOOK = 1.0  # seconds to learn the module's state before it is ordered
_ROUND = 5.0  # seconds of listening for ALIVE
_LOOK = 0.02
_REPEAT = 1.0
_PROMPT = 0.2  # firmware says ALIVE 10 ms after an order to restart

app = session.group("Modules: list, stop, reboot, bootload.")

TOOLS_THERE = "; there are tools, which --all shows"

Name = Annotated[str, typer.Argument(metavar="MODULE", show_default=False)]
All = Annotated[bool, typer.Option("--all", "-a", help="Also tools, whose names begin with _.")]


@session.command(app, "list")
async def list_(session: Session, *, all: All = False, wait: Wait = None, format: Format = None) -> None:
    """List the modules: state, kind (r2p or firmware), the link they are on, and seconds since they were heard."""
    output = Output(format)
    await session.settle(wait, of="modules")
    if wait is None:
        await _hear_firmware(session)
    known = [view for view in session.module.network.modules() if view.link]
    views = [view for view in known if all or not view.name.startswith("_")]
    columns = ["module", "state", "rebooted", "kind", "link", "age"]
    await output.table([_row(view) for view in views], columns, units={"age": "s"})
    if not views:
        session.say(f"no module has been heard on {session.where}{TOOLS_THERE if known else ''}")


async def _hear_firmware(session: Session) -> None:
    """Firmware says its name once in a round of all its topics: give it time, if nobody else is at its link."""

    def named() -> bool:
        known = {view.link for view in session.module.network.modules()}
        return all(link.name in known for link in session.module.links if link.up and link.passes_probes)

    with session.waiting("ALIVE of firmware"):
        await _until(named, _ROUND)


async def _until(condition: Callable[[], bool], patience: float) -> bool:
    """Wait until it is so; False if it is not after `patience` seconds."""
    loop = asyncio.get_running_loop()
    end = loop.time() + patience
    while not condition():
        if loop.time() >= end:
            return False
        await asyncio.sleep(_LOOK)
    return True


@session.command(app, "stop")
async def stop(session: Session, module: Name, *, timeout: Timeout = None) -> None:
    """End a module's nodes; reboot starts them again. No emergency stop: it may take a second, or get lost."""
    await _order(session, r2p.Command.STOP, module, timeout, lambda watch: bool(watch.flags[-1] & FLAG_STOPPED))


@session.command(app, "reboot")
async def reboot(session: Session, module: Name, *, timeout: Timeout = None) -> None:
    """Restart a module's firmware, or the nodes of an r2p module."""
    await _order(session, r2p.Command.REBOOT, module, timeout, _has_rebooted)


@session.command(app, "bootload")
async def bootload(session: Session, module: Name, *, timeout: Timeout = None) -> None:
    """Restart a module into its boot loader; reboot leaves it. Programs on a PC have none, and refuse."""
    await _order(session, r2p.Command.BOOTLOAD, module, timeout, lambda watch: bool(watch.flags[-1] & FLAG_BOOT))


class _CommandWatch(msgspec.Struct):
    """What was heard of a module: its flags one after the other, and how long (s) after the order firmware spoke.

    `denied`: why a gateway does not let the order through, in words; `refused`: why it is not given at all.
    """

    flags: list[int]
    delay: float | None = None
    denied: str = ""
    refused: r2p.Error | None = None


def _has_rebooted(watch: _CommandWatch) -> bool:
    """A new start shows in the flags; those of firmware that was rebooted before in an ALIVE right after the order."""
    if not _restarted(watch.flags[-1]):
        return False
    changed = any(_restarted(after) and not _restarted(before) for before, after in pairwise(watch.flags))
    return changed or (watch.delay is not None and 0 <= watch.delay < _PROMPT)


def _restarted(flags: int) -> bool:
    return flags & (FLAG_REBOOTED | FLAG_STOPPED | FLAG_BOOT) == FLAG_REBOOTED


_DONE = {r2p.Command.STOP: "stopped", r2p.Command.REBOOT: "rebooted", r2p.Command.BOOTLOAD: "in its boot loader"}


async def _order(
    session: Session, command: r2p.Command, name: str, timeout: float | None, done: Callable[[_CommandWatch], bool]
) -> None:
    module_path(name)
    if not session.settings.via:
        raise Usage("there is nobody to order around: give --via tcp:HOST:PORT, or set R2P_VIA")
    await session.settle(wait=0)
    loop = asyncio.get_running_loop()
    started = loop.time()
    watch = _CommandWatch([])
    with session.waiting(f"{name} to confirm {command.name}"):
        try:
            async with asyncio.timeout(timeout or TIMEOUT), asyncio.TaskGroup() as tasks:
                watch.flags += [_flags(view) for view in [_find(session, name)] if view is not None]
                follower = tasks.create_task(_follow(session.module.events(), name, f"{command.name} denied", watch))
                await _confirmed(session, command, name, watch, done)
                follower.cancel()
        except TimeoutError:
            raise TimedOut(_what_was_seen(session, command, name, timeout or TIMEOUT)) from None
    if watch.refused:
        raise watch.refused
    if watch.denied:
        raise TimedOut(watch.denied)
    session.say(f"{name}: {_DONE[command]}, after {loop.time() - started:.1f} s")


async def _follow(events: AsyncIterator[r2p.ModuleEvent], name: str, denial: str, watch: _CommandWatch) -> None:
    """Note each change of the module's flags, and that a gateway denies the order."""
    async for event in events:
        match event:
            case r2p.ModuleChanged(info=info) if info.name == name:
                watch.flags.append(info.flags)
            case r2p.LinkNotice(kind=kind, text=text) if kind == denial:
                watch.denied = text


async def _confirmed(
    session: Session, command: r2p.Command, name: str, watch: _CommandWatch, done: Callable[[_CommandWatch], bool]
) -> None:
    """Send the order, again and again, until the module confirms it."""
    loop = asyncio.get_running_loop()
    await _until(lambda: bool(watch.flags), _FIRST_LOOK)
    ordered = loop.time()

    def is_done() -> bool:
        view = _find(session, name)
        watch.delay = None if view is None or view.instance is not None else loop.time() - view.age - ordered
        return bool(watch.denied) or (bool(watch.flags) and done(watch))

    while not watch.denied:
        try:
            session.module.command(command, name)
        except r2p.Error as error:
            watch.refused = error
            return
        ordered = loop.time()
        if await _until(is_done, _REPEAT):
            return


def _flags(view: r2p.ModuleView) -> int:
    state = {"stopped": FLAG_STOPPED, "boot": FLAG_BOOT}.get(view.state, 0)
    return state | (FLAG_REBOOTED if view.rebooted else 0)


def _find(session: Session, name: str) -> r2p.ModuleView | None:
    """The module as it was heard last, on whichever link."""
    views = [view for view in session.module.network.modules() if view.name == name and view.link]
    return min(views, key=lambda view: view.age, default=None)


def _what_was_seen(session: Session, command: r2p.Command, name: str, timeout: float) -> str:
    view = _find(session, name)
    if view is None:
        heard = sorted({view.name for view in session.module.network.modules() if view.state != "observer"})
        return f"nothing was heard of {name} in {timeout:g} s; heard of: {', '.join(heard) or 'nobody'}"
    text = f"{name} did not confirm {command.name} in {timeout:g} s: it is {view.state}, heard {view.age:.1f} s ago"
    if command is r2p.Command.BOOTLOAD and view.instance is not None:
        text += "; it is a program on a PC, those have no boot loader and refuse"
    elif command is r2p.Command.REBOOT and view.rebooted:
        text += "; it had been rebooted before, so its ALIVE may not tell"
    elif view.link.partition(":")[0] in {"tcp", "zenoh"}:
        text += "; if there is a gateway in between, does it have --allow-control?"
    return text


def _row(view: r2p.ModuleView) -> dict[str, Any]:
    return {
        "module": view.name,
        "state": view.state,
        "rebooted": view.rebooted,
        "kind": "firmware" if view.instance is None else "r2p",
        "link": view.link,
        "age": round(view.age, 1),
    }
