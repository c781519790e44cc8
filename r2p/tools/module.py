"""`r2p module`: list modules, and send them commands.

A command may get lost, so it is repeated until the module's ALIVE confirms it. None of them is an emergency stop.
"""

import asyncio
import difflib
from collections.abc import AsyncIterator
from typing import Annotated, Any

import typer

import r2p
from r2p.codecs.management import WIRE_VERSION
from r2p.messages.values import to_plain
from r2p.monitoring.commands import TIMEOUT, CommandProgress
from r2p.names import module_alias, module_path
from r2p.tools import session
from r2p.tools.completion import complete_module
from r2p.tools.options import All, Format, Timeout, Wait
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, TimedOut, UsageError, alias_or_none, wait_until

_FIRST_STATE = 1.0  # seconds to learn the module's state before the first command
_ROUND = 5.0  # seconds in which firmware sends ALIVE at least once
_REPEAT = 1.0  # seconds between two commands

app = session.group("List, stop and restart modules.")

Name = Annotated[str, typer.Argument(metavar="MODULE", autocompletion=complete_module, show_default=False)]


@session.command(app, "list")
async def list_(session: Session, *, all: All = False, wait: Wait = None, format: Format = None) -> None:
    """List the modules and their state.

    The kind is r2p, firmware or ROS, and the age is the time since the last message from the module. With -v also the
    alias of each long name, which travels on RTCAN and debug lines.
    """
    output = Output(format)
    await session.settle(wait, of="modules")
    if wait is None:
        await _wait_for_firmware(session)
    known = [view for view in session.module.network.modules() if view.link]
    views = [view for view in known if all or not view.name.startswith("_")]
    columns = session.columns("module", "state", "rebooted", "kind", "version", "wire", "link", "age")
    rows = [_row(view, for_people=output.format == "text") for view in views]
    await output.table(rows, columns, units={"age": "s"})
    if not views:
        session.report_none("modules", hidden=bool(known))


async def _wait_for_firmware(session: Session) -> None:
    """Wait for the name of firmware, which it sends once in a round of all its topics, on links without a module."""

    def named() -> bool:
        known = {view.link for view in session.module.network.modules()}
        return all(link.name in known for link in session.module.links if link.up and link.passes_probes)

    with session.waiting("ALIVE of firmware"):
        await wait_until(named, _ROUND)


@session.command(app, "info")
async def info(session: Session, module: Name, *, wait: Wait = None, format: Format = None) -> None:
    """Show a module's state and its counters.

    Counters of nodes, publishers, subscribers and links, by topic and by reason; laxities are in ms. Firmware has none.
    """
    output = Output(format)
    module_path(module)
    await session.settle(wait, of="modules")
    if wait is None:
        with session.waiting(f"module {module}"):
            await session.look_for(lambda: _find(session, module) is not None)
    view = _find(session, module)
    if view is None:
        raise r2p.Error(unknown_module(session, module))
    module = view.name
    record = _row(view, for_people=output.format == "text")
    if view.instance is None:
        notify(f"{module} is firmware: it counts nothing that others can ask for")
        await output.put(record)
        return
    if view.kind == "ROS":
        notify(f"{module} is a ROS node: it counts nothing that others can ask for")
        await output.put(record)
        return
    try:
        with session.waiting(f"the statistics of {module}"):
            statistics = await session.module.network.statistics(module)
    except TimeoutError as error:
        raise TimedOut(str(error)) from error
    await output.put(record | _counters(statistics))


def _counters(statistics: r2p.ModuleStatistics) -> dict[str, Any]:
    """Return the statistics with losses by reason, and None for an unknown laxity."""
    plain = to_plain(statistics)
    for link in plain["links"]:
        for name in ("lost", "faults"):
            link[name] = {each["reason"]: each["count"] for each in link[name]}
    for topic in plain["topics"]:
        topic["least_laxity"] = None if topic["least_laxity"] == "NaN" else topic["least_laxity"]
    return plain


@session.command(app, "stop")
async def stop(session: Session, module: Name, *, timeout: Timeout = None) -> None:
    """Stop a module's nodes; reboot starts them again. Not an emergency stop: it may take a second, or get lost."""
    await _send(session, r2p.Command.STOP, module, timeout)


@session.command(app, "reboot")
async def reboot(session: Session, module: Name, *, timeout: Timeout = None) -> None:
    """Restart a module's firmware, or the nodes of an r2p module."""
    await _send(session, r2p.Command.REBOOT, module, timeout)


@session.command(app, "bootload")
async def bootload(session: Session, module: Name, *, timeout: Timeout = None) -> None:
    """Restart a module into its boot loader; reboot leaves it. Programs on a PC have no boot loader, and refuse."""
    await _send(session, r2p.Command.BOOTLOAD, module, timeout)


_DONE = {r2p.Command.STOP: "stopped", r2p.Command.REBOOT: "rebooted", r2p.Command.BOOTLOAD: "in its boot loader"}


async def _send(session: Session, command: r2p.Command, name: str, timeout: float | None) -> None:
    module_path(name)
    if not session.settings.via:
        raise UsageError("no network to send a command on: give --via tcp:HOST:PORT or set R2P_VIA")
    await session.settle(wait=0)
    session.module.query()
    loop = asyncio.get_running_loop()
    started, limit = loop.time(), timeout or TIMEOUT
    sender = _CommandSender(session, command, name)
    watching = asyncio.create_task(sender.watch(session.module.events()))
    try:
        with session.waiting(sender.awaited):
            async with asyncio.timeout(limit):
                await sender.repeat_until_confirmed()
    except TimeoutError:
        raise TimedOut(_timeout_text(session, command, name, limit)) from None
    finally:
        watching.cancel()
        sender.close()
    notify(f"{sender.name}: {_DONE[command]} after {loop.time() - started:.1f} s")


class _CommandSender:
    """Sends one command to a module, and watches what the module does since."""

    def __init__(self, session: Session, command: r2p.Command, name: str) -> None:
        view = _find(session, name)
        if view is not None and view.kind == "ROS":
            raise r2p.Error(f"{view.name} is a ROS node, which knows no {command.name}: use the commands of ROS")
        self._session = session
        self._command = command
        self._progress = CommandProgress(command, view, name)
        self._sent_at = 0.0
        self._heard_all = asyncio.create_task(session.announcements.heard_all())
        self._firmware_heard_at = asyncio.get_running_loop().time() + _ROUND  # by then each has sent ALIVE

    @property
    def name(self) -> str:
        """The name of the module; what the user has given, which may be its alias, until the module is known."""
        return self._progress.name

    def close(self) -> None:
        self._heard_all.cancel()

    def awaited(self) -> str:
        """Say what the command waits for."""
        if self._progress.flags:
            return f"{self.name} to confirm {self._command.name}"
        if not self._may_be_firmware():
            return f"{self.name} to announce itself"
        return f"{self.name} (firmware announces itself within {_ROUND:g} s)"

    async def watch(self, events: AsyncIterator[r2p.ModuleEvent]) -> None:
        """Note each change of the module's flags, and whether a gateway denies the command."""
        async for event in events:
            self._progress.note(event)

    async def repeat_until_confirmed(self) -> None:
        """Send the command until the module confirms it.

        Raises r2p.Error if there is no such module or it can't obey, and if a gateway denies the command.
        """
        await wait_until(lambda: bool(self._progress.flags) or self._is_unknown(), _FIRST_STATE)
        while True:
            if self._is_unknown():
                raise r2p.Error(unknown_module(self._session, self.name))
            await self._check_has_loader()
            if not self._progress.flags:
                self._session.module.query()  # again: a gateway may not have heard the first one
            self._session.module.command(self._command, self.name)
            self._sent_at = asyncio.get_running_loop().time()
            if await wait_until(self._is_over, _REPEAT) and not self._is_unknown():
                break
        if self._progress.denied:
            raise r2p.Error(self._progress.denied)

    async def _check_has_loader(self) -> None:
        """Raise r2p.Error if the command needs a boot loader, and the module has none: it says so after its name."""
        if self._command is not r2p.Command.BOOTLOAD:
            return

        def has_loader() -> bool:
            view = _find(self._session, self.name)
            return view is None or view.has_loader

        if not has_loader():
            self._session.module.query()
        if not await wait_until(has_loader, _FIRST_STATE):
            raise r2p.Error(f"{self.name} is an r2p module, a program without a boot loader: it would refuse BOOTLOAD")

    def _is_over(self) -> bool:
        return bool(self._progress.denied) or self._confirmed() or self._is_unknown()

    def _is_unknown(self) -> bool:
        """Return whether the module would have been heard by now."""
        if self._progress.flags or not self._heard_all.done():
            return False
        return not self._may_be_firmware() or asyncio.get_running_loop().time() >= self._firmware_heard_at

    def _may_be_firmware(self) -> bool:
        on_bus = any(link.up and link.has_slots for link in self._session.module.links)
        return on_bus or self._session.announcements.may_have_firmware()

    def _confirmed(self) -> bool:
        since = asyncio.get_running_loop().time() - self._sent_at
        return self._progress.is_confirmed(_find(self._session, self.name), since)


def _find(session: Session, name: str) -> r2p.ModuleView | None:
    """Return the module of this name, or with this alias, as it was last seen, on any link.

    Raises r2p.Error for the alias of several modules.
    """
    known = [view for view in session.module.network.modules() if view.link]
    views = [view for view in known if view.name == name]
    views = views or [view for view in known if module_alias(view.name) == name]
    if views and views[0].name != name:
        others = {link.discovery.other_module(view.name) for link in session.module.links for view in views}
        names = sorted({view.name for view in views} | others - {""})
        if len(names) > 1:
            raise r2p.Error(f"{name} is the alias of {' and '.join(names)}: rename one (--module)")
    return min(views, key=lambda view: view.age, default=None)


def unknown_module(session: Session, name: str) -> str:
    found = sorted({view.name for view in session.module.network.modules() if view.link and view.state != "observer"})
    close = [each for each in found if each.rpartition("/")[2] == name]  # one of each robot: none is likelier
    close = close or difflib.get_close_matches(name, found, cutoff=0.5)
    question = f"; did you mean {' or '.join(close)}?" if close else ""
    return f"there is no module {name} on {session.network_name}; modules found: {', '.join(found) or 'none'}{question}"


def _timeout_text(session: Session, command: r2p.Command, name: str, timeout: float) -> str:
    view = _find(session, name)
    if view is None:
        return f"{unknown_module(session, name)}; gave up after {timeout:g} s"
    text = f"{name} did not confirm {command.name} in {timeout:g} s: it is {view.state}, last seen {view.age:.1f} s ago"
    if command is r2p.Command.REBOOT and view.rebooted:
        text += "; it had been rebooted before, so its ALIVE may not show it"
    elif command is not r2p.Command.STOP and view.link.partition(":")[0] in {"tcp", "zenoh"}:
        text += "; if a gateway is in between, it must have --allow-control"
    elif view.link.startswith("zenoh"):
        text += "; does the access control of a zenoh router deny it?"
    return text


def _row(view: r2p.ModuleView, *, for_people: bool) -> dict[str, Any]:
    other = for_people and view.wire not in {None, WIRE_VERSION}
    return {
        "module": view.name,
        "alias": alias_or_none(view.name, module_alias),
        "state": view.state,
        "rebooted": view.rebooted,
        "kind": view.kind,
        "version": view.release,
        "wire": f"{view.wire}, not {WIRE_VERSION}" if other else view.wire,
        "link": view.link,
        "age": round(view.age, 1),
    }
