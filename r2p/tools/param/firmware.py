"""`r2p param --firmware APP`: the parameters of an app in the flash of a firmware module.

The module has to be in its boot loader, and knows nothing of them but their bytes: its config area. A message class of
the same bytes (`--as`) gives these their names and types. What is set is read back, as an ACK is no proof.
"""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator
from typing import Annotated, Any

import typer

import r2p
from r2p.loader import InstalledApp, LoaderClient, LoaderSilent
from r2p.messages.values import flatten, parse, pick, to_plain
from r2p.tools.completion import complete_type
from r2p.tools.module import unknown_module
from r2p.tools.output import Output, notify
from r2p.tools.param.targets import similar
from r2p.tools.param.texts import put_all
from r2p.tools.session import Session, TimedOut, UsageError, wait_until
from r2p.tools.types import Types, type_name

App = Annotated[
    str | None,
    typer.Option("--firmware", metavar="APP", help="The config area of this app of MODULE, which is firmware."),
]
As = Annotated[
    str | None,
    typer.Option(
        "--as", metavar="TYPE", autocompletion=complete_type, help="What is in it: FILE.py:Class, an r2p.Message."
    ),
]
Raw = Annotated[
    str | None, typer.Option("--raw", metavar="OFFSET:LENGTH", help="Only these bytes of it, as hex; to set, too.")
]
Reboot = Annotated[bool, typer.Option("--reboot", help="Restart the module into its boot loader, and back at the end.")]

_ALIVE = 6.0  # seconds in which firmware sends ALIVE at least once
_LOADER = 1.0  # seconds until a module has said behind its name that it has a boot loader
_HEX = re.compile(r"[0-9a-fA-F]*")


class ConfigArea:
    """The config area of an app, or a part of it, while the module is in its boot loader."""

    def __init__(
        self, loader: LoaderClient, app: InstalledApp, cls: type[r2p.Message] | None, part: range | None
    ) -> None:
        self._loader = loader
        self.cls = cls
        """The type of its content; None: bytes."""
        self.app = app.name
        self.module = loader.name
        self.part = range(app.outcome.cfglen) if part is None else part
        """The offsets of the bytes in question."""

    async def read(self) -> bytes:
        """Return the bytes."""
        if not self.part:
            return b""
        return await self._loader.get(self.app, self.part.start, len(self.part))

    async def write(self, offset: int, data: bytes) -> None:
        """Write bytes, and read them back."""
        await self._loader.set(self.app, offset, data)


def check_unused(as_: str | None, raw: str | None, *, reboot: bool) -> None:
    """Raise UsageError for options that mean something with --firmware only."""
    for option, given in (("--as", as_), ("--raw", raw), ("--reboot", reboot)):
        if given:
            raise UsageError(f"{option} is for the parameters of firmware: give --firmware APP, too")


@contextlib.asynccontextmanager
async def config_area(
    session: Session, module: str | None, app: str, as_: str | None, raw: str | None, *, reboot: bool
) -> AsyncIterator[ConfigArea]:
    """Open the config area of an app. With `reboot`, the module restarts into its boot loader, and back at the end.

    Raises TimedOut if the module does not answer, and r2p.Error if it is not in its boot loader or has no such app.
    """
    if module is None:
        raise UsageError("--firmware needs a MODULE: r2p param list MODULE --firmware APP")
    cls, part = _checked(session, as_, raw)
    if not session.settings.via:
        raise UsageError("no network to look for firmware on: give --via tcp:HOST:PORT or set R2P_VIA")
    await session.settle(wait=0)
    try:
        async with LoaderClient(session.module, module) as loader, _in_loader(session, loader, reboot=reboot):
            with session.waiting(f"the apps of {module}"):
                listing = await loader.list_apps()
            found = listing.find(app)
            if found is None:
                raise r2p.Error(f"{module} has no app {app}{similar(app, (a.name for a in listing.apps), 'it has')}")
            _check_fits(found, cls, part)
            with session.waiting(f"the config area of {app}"):
                yield ConfigArea(loader, found, cls, part)
    except LoaderSilent as error:
        raise TimedOut(str(error)) from error


async def list_(area: ConfigArea, output: Output) -> None:
    """Print the fields, or the bytes."""
    data = await area.read()
    if area.cls is None:
        await _put_bytes(area, output, data)
        return
    leaves = flatten(to_plain(_decoded(area, area.cls, data)))
    rows = [{"module": area.module, "app": area.app, "name": name, "value": value} for name, value in leaves.items()]
    await output.table(rows, ["module", "app", "name", "value"])


async def get(area: ConfigArea, output: Output, names: list[str]) -> None:
    """Print the values of fields, or the bytes."""
    if area.cls is None:
        if names:
            raise UsageError(f"the names of the bytes of {area.app} are unknown: give --as FILE.py:Class")
        await _put_bytes(area, output, await area.read())
        return
    message = _decoded(area, area.cls, await area.read())
    values = {name: _picked(message, name) for name in names} or to_plain(message)
    rows = [{"module": area.module, "app": area.app, "name": name, "value": value} for name, value in values.items()]
    await put_all(output, rows, [f"{_name(row)} = {_text(row['value'])}" for row in rows])


async def set_(area: ConfigArea, output: Output, words: list[str]) -> None:
    """Set fields, NAME=VALUE or NAME VALUE, or the bytes, as hex; and read them back."""
    for word in words:
        if word.startswith("--"):
            raise UsageError(f"there is no option {word}")
    before = await area.read()
    after = _bytes(area, words) if area.cls is None else _with_fields(area, area.cls, before, words)
    changed = [i for i, (old, new) in enumerate(zip(before, after, strict=True)) if old != new]
    if changed:
        first, last = changed[0], changed[-1] + 1
        await area.write(area.part.start + first, after[first:last])
        notify(
            f"{area.app} on {area.module}: {last - first} byte{'s' if last - first > 1 else ''} written and read back"
        )
    else:
        notify(f"{area.app} on {area.module}: as it was")
    if area.cls is None:
        await _put_bytes(area, output, after)
        return
    old, new = (flatten(to_plain(_decoded(area, area.cls, data))) for data in (before, after))
    rows = [
        {"module": area.module, "app": area.app, "name": name, "value": value, "before": old[name]}
        for name, value in new.items()
        if value != old[name]
    ]
    texts = [f"{_name(row)} = {_text(row['value'])} (was {_text(row['before'])})" for row in rows]
    if rows:
        await put_all(output, rows, texts)


def _name(row: dict[str, Any]) -> str:
    return f"{row['module']} {row['app']}.{row['name']}"


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


# The module


@contextlib.asynccontextmanager
async def _in_loader(session: Session, loader: LoaderClient, *, reboot: bool) -> AsyncIterator[None]:
    """Check that the module is in its boot loader, or take it there; and back at the end."""
    await _check_state(session, loader, reboot=reboot)
    try:
        with session.waiting(f"the boot loader of {loader.name}"):
            await loader.enter()
    except asyncio.CancelledError:  # by Ctrl-C, perhaps after BOOTLOAD
        if reboot:
            await _back(session, loader)
        raise
    try:
        yield
    except BaseException:
        if reboot:
            await _back(session, loader)
        raise
    if reboot:
        with session.waiting(f"{loader.name} to restart"):
            await loader.leave()
        notify(f"{loader.name}: rebooted")


async def _back(session: Session, loader: LoaderClient) -> None:
    """Restart the module after an error, which is the one to report."""
    try:
        with session.waiting(f"{loader.name} to restart"):
            await loader.leave()
    except r2p.Error as error:
        notify(f"{loader.name} is still in its boot loader ({error}): r2p module reboot {loader.name}")


async def _check_state(session: Session, loader: LoaderClient, *, reboot: bool) -> None:
    """Raise TimedOut for an unknown module, and r2p.Error for one that is not in its boot loader.

    With `reboot`, firmware may be silent until it is restarted.
    """
    session.module.query()
    with session.waiting(f"{loader.name} (firmware announces itself within 5 s)"):
        await wait_until(lambda: loader.view() is not None, _ALIVE)
        await wait_until(lambda: (found := loader.view()) is None or found.has_loader, _LOADER)
    view = loader.view()
    if view is None:
        if reboot and session.announcements.may_have_firmware():
            return
        raise TimedOut(unknown_module(session, loader.name))
    if not view.has_loader:
        raise r2p.Error(f"{loader.name} is an r2p module, not firmware: leave out --firmware")
    if view.state != "boot" and not reboot:
        raise r2p.Error(
            f"{loader.name} is {view.state}: its parameters can be read in its boot loader only, where its nodes do "
            "not run. Add --reboot to go there and back"
        )


# Fields and bytes


def _checked(session: Session, as_: str | None, raw: str | None) -> tuple[type[r2p.Message] | None, range | None]:
    """Return what --as and --raw mean. Raises UsageError."""
    if as_ is not None and raw is not None:
        raise UsageError("--as shows fields, and --raw bytes: leave out one of them")
    if raw is not None:
        return None, _range(raw)
    if as_ is None:
        return None, None
    cls = Types(session.settings).load(as_)
    if r2p.layout(cls).varies:
        raise UsageError(f"--as {as_}: the length of {type_name(cls)} varies, that of a config area is fixed")
    return cls, None


def _range(raw: str) -> range:
    """Return the offsets that OFFSET:LENGTH means."""
    try:
        offset, length = (int(part, 0) for part in raw.split(":"))
    except ValueError:
        offset = length = -1
    if offset < 0 or length < 1:
        raise UsageError(f"--raw {raw}: write it as OFFSET:LENGTH, for example 0:16 or 0x10:4")
    return range(offset, offset + length)


def _check_fits(app: InstalledApp, cls: type[r2p.Message] | None, part: range | None) -> None:
    """Raise r2p.Error if the config area of an app is not as large as --as or --raw wants it."""
    size = app.outcome.cfglen
    if cls is not None and r2p.layout(cls).size != size:
        own = r2p.layout(cls).size
        raise r2p.Error(f"{type_name(cls)} has {own} bytes, but the config area of {app.name} {size}: nothing is done")
    if part is not None and part.stop > size:
        raise r2p.Error(f"the config area of {app.name} has {size} bytes: {part.start}:{len(part)} is not inside of it")


def _decoded(area: ConfigArea, cls: type[r2p.Message], data: bytes) -> r2p.Message:
    try:
        return cls.decode(data)
    except r2p.DecodeError as error:
        raise r2p.Error(f"the config area of {area.app} is not a {type_name(cls)}: {error}; try --raw") from error


def _picked(message: r2p.Message, name: str) -> Any:
    try:
        return pick(message, name)
    except KeyError as error:
        raise r2p.Error(str(error.args[0])) from error


def _with_fields(area: ConfigArea, cls: type[r2p.Message], before: bytes, words: list[str]) -> bytes:
    """Return the bytes with some fields set. The others keep theirs, also what is behind the end of a text."""
    if len(words) == 2 and "=" not in words[0]:
        words = ["=".join(words)]
    if not words or not all("=" in word for word in words):
        raise UsageError("write NAME=VALUE for each field that is to be set")
    old = _decoded(area, cls, before)
    try:
        new = parse(cls, [json.dumps(to_plain(old)), *words])
    except r2p.MessageError as error:
        raise UsageError(str(error)) from error
    packed, unchanged, after, offset = new.encode(), old.encode(), bytearray(before), 0
    for field in r2p.layout(cls).fields:
        end = offset + field.shape.size
        if packed[offset:end] != unchanged[offset:end]:
            after[offset:end] = packed[offset:end]
        offset = end
    return bytes(after)


def _bytes(area: ConfigArea, words: list[str]) -> bytes:
    text = "".join("".join(words).split())
    if not _HEX.fullmatch(text) or len(text) != 2 * len(area.part) or not text:
        raise UsageError(
            f"without --as, r2p param set writes bytes: give --raw OFFSET:LENGTH and the bytes, as hex, such as "
            f"{'00' * min(len(area.part), 4)} for {min(len(area.part), 4)} bytes"
        )
    return bytes.fromhex(text)


async def _put_bytes(area: ConfigArea, output: Output, data: bytes) -> None:
    record = {"module": area.module, "app": area.app, "offset": area.part.start, "length": len(data), "hex": data.hex()}
    text = f"{area.module} {area.app} {area.part.start}:{len(data)} = {data.hex(' ')}"
    await output.put(record, text, wrap=True)
