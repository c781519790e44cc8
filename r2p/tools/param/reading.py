"""`r2p param list`, `get`, `info`, `dump` and `watch`: commands that change nothing."""

import asyncio
from collections.abc import Callable
from typing import Any

import r2p
from r2p.tools.log import clock_text
from r2p.tools.options import Count, Format, Once, Timeout, Wait
from r2p.tools.output import Output, notify
from r2p.tools.param import firmware as on_firmware
from r2p.tools.param.arguments import MaybeTarget, Names, Target
from r2p.tools.param.firmware import App, As, Raw, Reboot
from r2p.tools.param.targets import find, find_modules, meant
from r2p.tools.param.texts import (
    COLUMNS,
    FIELDS,
    assignment,
    brief,
    details,
    dumped,
    plain,
    put_all,
    record,
    row,
    shown,
    value_text,
)
from r2p.tools.session import Session, patience

_AGAIN = 2.0  # seconds until a module that did not answer is asked again


async def list_(
    session: Session,
    target: MaybeTarget = None,
    *,
    firmware: App = None,
    as_: As = None,
    raw: Raw = None,
    reboot: Reboot = False,
    wait: Wait = None,
    format: Format = None,
) -> None:
    """List parameters: of all modules, of one, or of a node.

    With --firmware APP those of an app in the flash of firmware, whose fields --as describes.
    """
    output = Output(format)
    if firmware is not None:
        async with on_firmware.config_area(session, target, firmware, as_, raw, reboot=reboot) as area:
            await on_firmware.list_(area, output)
        return
    on_firmware.check_unused(as_, raw, reboot=reboot)
    infos = await find(session, target, wait=wait)
    if output.format == "text":
        await output.table([row(info) for info in infos], COLUMNS)
    else:
        await output.table([record(info) for info in infos], FIELDS)
    if not infos:
        session.report_none("parameters")


async def get(
    session: Session,
    target: Target,
    names: Names = None,
    *,
    firmware: App = None,
    as_: As = None,
    raw: Raw = None,
    reboot: Reboot = False,
    format: Format = None,
) -> None:
    """Print the values of parameters: of a node, or those that are named.

    With --firmware APP those of an app in the flash of firmware.
    """
    output = Output(format)
    if firmware is not None:
        async with on_firmware.config_area(session, target, firmware, as_, raw, reboot=reboot) as area:
            await on_firmware.get(area, output, names or [])
        return
    on_firmware.check_unused(as_, raw, reboot=reboot)
    infos = await find(session, target, names or [])
    rows = [brief(info) | {"value": plain(info.value), "unit": info.unit} for info in infos]
    await put_all(output, rows, [assignment(info, info.value) for info in infos])


async def info(session: Session, target: Target, names: Names = None, *, format: Format = None) -> None:
    """Show everything about parameters.

    Value and origin (code, saved file, r2p.toml, --params, --param, run time), what is saved, default, range, unit, and
    what it is for.
    """
    output = Output(format)
    infos = await find(session, target, names or [])
    await put_all(output, list(map(record, infos)), list(map(details, infos)))


async def dump(session: Session, target: MaybeTarget = None) -> None:
    """Print parameters as a TOML file.

    `r2p param load` and `r2p run --params` read it.
    """
    infos = await find(session, target)
    if not infos:
        raise r2p.Error(session.none_yet("parameters"))
    output = Output()
    output.format = "text"  # in a pipe, too: it is for a file
    await output.put({}, dumped(infos).rstrip("\n"))


async def watch(
    session: Session,
    target: MaybeTarget = None,
    names: Names = None,
    *,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Print each change of parameters, until Ctrl-C.

    A module that does not answer is asked again: watching goes on when it is back.
    """
    output = Output(format)
    infos = await find(session, target, names or [])
    modules = list(dict.fromkeys(each.module for each in infos)) or await find_modules(session, target)
    if not modules:
        raise r2p.Error(session.none_yet("modules with parameters"))
    watched = f"{len(infos)} parameter{'' if len(infos) == 1 else 's'} of {', '.join(modules)}"
    async with output.while_read(), patience(f"no change of {watched}", timeout) as received:
        printer = _ChangePrinter(output, target, names or [], received)
        printer.remember(infos)
        async with asyncio.TaskGroup() as tasks:
            watching = [tasks.create_task(printer.watch(session, module)) for module in modules]
            printer.remember(await find(session, target, names or []))  # after the watch began: no change is missed
            notify(f"watching {watched}; Ctrl-C ends it")
            await printer.wait(1 if once else count)
            for task in watching:
                task.cancel()


class _ChangePrinter:
    """Prints the changes of parameters that a reference means."""

    def __init__(
        self,
        output: Output,
        target: str | None,
        names: list[str],
        received: Callable[[], None],
    ) -> None:
        self._output = output
        self._target = target
        self._names = names
        self._received = received
        self._values: dict[str, Any] = {}
        self._last = asyncio.Event()
        self._left: int | None = None

    def remember(self, infos: list[r2p.ParameterInfo]) -> None:
        """Note the values before the changes."""
        self._values |= {each.full_name: each.value for each in infos}

    async def wait(self, count: int | None) -> None:
        """Wait until `count` changes are printed, from now on (None: for ever)."""
        self._left = count
        await self._last.wait()

    async def watch(self, session: Session, module: str) -> None:
        """Print the changes of one module, whatever it does meanwhile."""
        while True:
            try:
                async for change in session.module.network.watch_parameters(module):
                    await self._print(session, change)
            except (r2p.Error, TimeoutError) as error:
                notify(f"{error}; trying again")
            await asyncio.sleep(_AGAIN)
            session.module.query()

    async def _print(self, session: Session, info: r2p.ParameterInfo) -> None:
        if self._left == 0 or not self._is_meant(info):
            return
        before = self._values.get(info.full_name)
        if before == info.value:  # it was saved, or has another origin
            return
        self._values[info.full_name] = info.value
        self._received()
        stamp = session.node.now()
        was = "new" if before is None else f"was {shown(info, before)}"
        text = f"{clock_text(stamp)} {assignment(info, info.value)} ({was}; {info.origin})"
        written = value_text if self._output.format == "csv" else plain  # of one column, whatever has changed
        changed = {"stamp": stamp} | brief(info) | {"value": written(info.value)}
        changed |= {"before": None if before is None else written(before), "unit": info.unit, "origin": info.origin}
        await self._output.put(changed, text)
        if self._left is not None:
            self._left -= 1
            if not self._left:
                self._last.set()

    def _is_meant(self, info: r2p.ParameterInfo) -> bool:
        in_target = self._target is None or bool(meant([info], self._target))
        return in_target and (not self._names or info.name in self._names)
