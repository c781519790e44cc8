"""What a session with a boot loader can do, one generator each: list, load, remove, get and set (PROTOCOL.md 5).

Each begins with its BEGIN message, whatever state the loader is in: in the middle of something it answers NACK, which
ends that, and the second BEGIN counts. Only BEGIN, DATA records and the record that sets their base are repeated: any
other message, once it has been carried out, would be refused when it comes again, and the refusal ends the session.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator

import msgspec

from r2p.codecs.loader import (
    CHUNK,
    FLAG_ENABLED,
    FLAGS_WORD,
    Ack,
    AppinfoSummary,
    BeginAppinfo,
    BeginGetparam,
    BeginLoader,
    BeginSetparam,
    EndAppinfo,
    EndGetparam,
    EndLoader,
    EndSetparam,
    IhexRecord,
    LinkingAddresses,
    LinkingOutcome,
    LinkingSetup,
    Loader,
    Nack,
    ParamChunk,
    ParamRequest,
    RemoveAll,
    RemoveLast,
)
from r2p.loader.session import (
    PATIENCE_REMOVE_ALL,
    LoaderConfused,
    LoaderError,
    LoaderStep,
    Procedure,
    T,
    expect,
    message_name,
)

PARAM_MAX = 240
"""Bytes that one request gets or sets, at most: whole chunks within the 255 of the wire."""
FLAGS_SIZE = 2
"""Bytes of an app's flags."""

_APPS_MAX = 1024  # of a listing; flash has room for some hundred at most
_BEGIN_REPEATS = 9  # the first requests are lost until the topic is negotiated, on a bus and at gateways
_RECORD_REPEATS = 3
_NACKS = 3  # of BEGIN in a row: one is enough to end a session, and more would mean that something else is wrong
_ACK_PAUSE = 0.05  # seconds for an ACK without an answer: the loader polls each 10 ms, and on CAN holds one message

LinkFunction = Callable[[LinkingAddresses], tuple[LinkingOutcome, Iterable[IhexRecord]]]
"""Links an app for the addresses of the loader. Raises LoaderError if it can't, which ends the session."""


class InstalledApp(msgspec.Struct, frozen=True):
    """An app in the module's flash. `setup.flags` mean nothing here: get the flags word instead."""

    setup: LinkingSetup
    addresses: LinkingAddresses
    outcome: LinkingOutcome

    @property
    def name(self) -> str:
        """The app's name."""
        return self.setup.name

    @property
    def ram(self) -> list[range]:
        """The memory of its .bss and its .data."""
        bss, data = self.addresses.bssadr, self.addresses.dataadr
        parts = [range(bss, bss + self.setup.bsslen), range(data, data + self.setup.datalen)]
        return [each for each in parts if each]


class AppListing(msgspec.Struct, frozen=True):
    """The memory of a module, and the apps in it in the order of their addresses: all but the last stay for good."""

    summary: AppinfoSummary
    apps: tuple[InstalledApp, ...]

    def find(self, name: str) -> InstalledApp | None:
        """Return the app of this name, or None."""
        return next((each for each in self.apps if each.name == name), None)


def _begin(message: Loader, kind: type[T]) -> Procedure[T]:
    answer: Loader = Nack()
    for _ in range(_NACKS):
        answer = yield LoaderStep(message, repeats=_BEGIN_REPEATS)
        if not isinstance(answer, Nack):
            break
    return expect(answer, kind, message_name(message))


def _ask(message: Loader, kind: type[T], patience: float = 0.0, repeats: int = 0) -> Procedure[T]:
    answer = yield LoaderStep(message, patience=patience, repeats=repeats)
    return expect(answer, kind, message_name(message))


def go_idle() -> Procedure[None]:
    """Abort the loader's current procedure. An unfinished load only leaves RAM in use."""
    yield from _begin(BeginLoader(), Ack)
    yield LoaderStep(BeginLoader())  # refused, as a session is open: that ends it


def list_apps() -> Procedure[AppListing]:
    """List the apps."""
    summary = yield from _begin(BeginAppinfo(), AppinfoSummary)
    apps: list[InstalledApp] = []
    while not isinstance(answer := (yield LoaderStep(Ack())), EndAppinfo):
        setup = expect(answer, LinkingSetup, "ACK of a listing")
        addresses = yield from _ask(Ack(), LinkingAddresses)
        outcome = yield from _ask(Ack(), LinkingOutcome)
        apps.append(InstalledApp(setup, addresses, outcome))
        if len(apps) > _APPS_MAX:
            raise LoaderConfused(f"the loader lists more than {_APPS_MAX} apps")
    yield from _ask(Ack(), Ack)
    if len(apps) != summary.numapps:
        raise LoaderConfused(f"the loader lists {len(apps)} apps and counts {summary.numapps}")
    return AppListing(summary, tuple(apps))


def load(
    setup: LinkingSetup, link: LinkFunction, progress: Callable[[int, int], None] = lambda done, total: None
) -> Procedure[LinkingAddresses]:
    """Load an app: its code is what `link` makes of the addresses. `progress` gets records done, and their number."""
    yield from _begin(BeginLoader(), Ack)
    addresses = yield from _ask(setup, LinkingAddresses)
    try:
        outcome, records = link(addresses)
    except LoaderError:
        with contextlib.suppress(LoaderError):
            yield LoaderStep(BeginLoader())  # refused: ends the session before anything is written
        raise
    yield from _ask(outcome, Ack)
    *data, end = records
    for done, record in enumerate(data):
        progress(done, len(data))
        yield from _ask(record, Ack, repeats=_RECORD_REPEATS)
    progress(len(data), len(data))
    yield from _ask(end, Ack)
    expect((yield LoaderStep(None)), Ack, "the end of the file")  # the app's entry is in the page buffer
    yield from _ask(EndLoader(), Ack)  # the last page is in flash
    return addresses


def remove_last() -> Procedure[None]:
    """Remove the last app. Raises LoaderRefused if no app is installed."""
    yield from _begin(BeginLoader(), Ack)
    yield from _ask(RemoveLast(), Ack)
    yield from _ask(EndLoader(), Ack)


def remove_all() -> Procedure[None]:
    """Remove all apps, and erase all pages: up to six seconds."""
    yield from _begin(BeginLoader(), Ack)
    yield from _ask(RemoveAll(), Ack, patience=PATIENCE_REMOVE_ALL)
    yield from _ask(EndLoader(), Ack)


def get(app: str, offset: int, length: int) -> Procedure[bytes]:
    """Get bytes of an app's config area, or its flags (FLAGS_WORD)."""
    yield from _begin(BeginGetparam(), Ack)
    data = b""
    for part in _parts(offset, length):
        data += yield from _get_part(app, part.start, len(part))
    yield from _ask(EndGetparam(), Ack)
    return data


def _get_part(app: str, offset: int, length: int) -> Procedure[bytes]:
    chunk = yield from _ask(ParamRequest(offset=offset, appname=app, length=length), ParamChunk)
    data = chunk.data
    while len(data) < length:
        chunk = yield from _ask(Ack(), ParamChunk)
        data += chunk.data
    yield LoaderStep(Ack(), pause=_ACK_PAUSE)
    return data[:length]


def set_(app: str, offset: int, data: bytes) -> Procedure[None]:
    """Set bytes of an app's config area, or its flags (FLAGS_WORD), PARAM_MAX bytes in each session.

    A board writes half words, and takes the other byte of one from its flash: no two chunks of a session may share one.
    """
    if offset % 2 and len(data) > CHUNK:
        yield from _set_part(app, offset, data[:1])
        offset, data = offset + 1, data[1:]
    for part in _parts(offset, len(data)):
        yield from _set_part(app, part.start, data[part.start - offset : part.stop - offset])


def _set_part(app: str, offset: int, data: bytes) -> Procedure[None]:
    yield from _begin(BeginSetparam(), Ack)
    yield from _ask(ParamRequest(offset=offset, appname=app, length=len(data)), Ack)
    for begin in range(0, len(data), CHUNK):
        yield from _ask(ParamChunk(data[begin : begin + CHUNK].ljust(CHUNK, b"\0")), Ack)
    yield from _ask(EndSetparam(), Ack)


def _parts(offset: int, length: int) -> Iterator[range]:
    stop = offset + length
    return (range(begin, min(begin + PARAM_MAX, stop)) for begin in range(offset, stop, PARAM_MAX))


def flags_are_enabled(data: bytes) -> bool:
    """Return whether the flags word says that the app starts with the module."""
    return bool(int.from_bytes(data, "little") & FLAG_ENABLED)


def with_enabled(data: bytes, *, enabled: bool) -> bytes:
    """Return the flags word with this flag, and all others as they are."""
    flags = int.from_bytes(data, "little") & ~FLAG_ENABLED
    return (flags | (FLAG_ENABLED if enabled else 0)).to_bytes(len(data), "little")


__all__ = [
    "FLAGS_SIZE",
    "FLAGS_WORD",
    "PARAM_MAX",
    "AppListing",
    "InstalledApp",
    "LinkFunction",
    "flags_are_enabled",
    "get",
    "go_idle",
    "list_apps",
    "load",
    "remove_all",
    "remove_last",
    "set_",
    "with_enabled",
]
