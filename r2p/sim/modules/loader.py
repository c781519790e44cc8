"""The loader of the firmware of 2014, emulated: messages in and messages out (PROTOCOL.md 5).

It answers as the recorded one, with the same numbers of source lines in a refusal, and it has its traps:

- Once the content of the page buffer is lost - by a restart before END_LOADER - so is the app.
- RAM is handed out downwards from its end, and forgotten at a restart: an aborted load keeps its RAM until then, and
  after it the next app gets the RAM of apps that are already installed.
- The second app of a session gets the addresses of the first.
- Bases of Intel hex records survive from one app to the next.
- Its queue holds 4 messages, and it looks at it every 10 ms; any more are lost without an answer.
- A length that wraps the address of the next app makes the list of apps endless: the module hangs.

It differs from firmware in one point: a character that is not printable counts as `?` in the name of an app to load,
and makes a request of its parameters unknown.
"""

from collections import Counter, deque
from collections.abc import Generator

import msgspec

from r2p.codecs import UnknownType, loader
from r2p.codecs.loader import (
    CHUNK,
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
from r2p.errors import DecodeError
from r2p.sim.modules.flash import ERASED, SIMULATED, Flash, FlashTimes, MemoryMap, PageBuffer
from r2p.sim.modules.installed import (
    ADDRESSES,
    FLAGS_SIZE,
    SIGNATURE,
    EndlessList,
    FlashApp,
    InstalledApps,
    entry,
)
from r2p.units import MILLISECOND

QUEUE = 4
"""Messages that wait for the loader."""

_POLL = 10 * MILLISECOND
_NAME_FIELD = slice(16, 24)  # of LinkingSetup

_Steps = Generator[None, Loader | None, None]


class LoaderFaults(msgspec.Struct):
    """Faults to inject, by number: messages to the loader, and its answers, are counted from 1 on.

    Each set may be changed at any time. For flash that wears out see `EmulatedLoader.flash.worn`, for damage
    `flash.data`; for power cuts `FirmwareModule.power_on`.
    """

    lost_requests: set[int] = msgspec.field(default_factory=set)
    lost_answers: set[int] = msgspec.field(default_factory=set)
    refused: set[int] = msgspec.field(default_factory=set)
    """Messages that are answered NACK, whatever they say."""


class EmulatedLoader:
    """The loader of a module, and the flash memory with its apps.

    All times are monotonic ns. `boot` starts it, at each start of the module in boot mode; `receive` takes messages,
    and `poll` returns the answers.
    """

    def __init__(
        self, memory: MemoryMap | None = None, *, times: FlashTimes = SIMULATED, faults: LoaderFaults | None = None
    ) -> None:
        """`times`: of the flash memory, by default none, as in the recordings; BOARD is those of a board."""
        self.memory = memory or MemoryMap()
        self.flash = Flash(self.memory, times)
        """The flash memory. It keeps its content without power."""
        self.apps = InstalledApps(self.flash)
        """The apps in it."""
        self.faults = faults or LoaderFaults()
        self.requests = 0
        """Messages received since the object was made, lost ones too."""
        self.answers = 0
        """Answers since the object was made, lost ones too."""
        self.drops: Counter[str] = Counter()
        """Lost messages, by reason."""
        self.fault = ""
        """Why it has failed, and the whole module with it."""
        self._pages = PageBuffer(self.flash)
        self._queue: deque[tuple[int, Loader | None]] = deque()
        self._ready: list[bytes] = []  # answers to the present message
        self._out: deque[tuple[int, bytes]] = deque()
        self._polled_at = 0  # when it found its queue empty
        self._next_at = 0  # when it handles the next message
        self._base = 0
        self._ram_free_to = self.memory.ram_end
        self._steps: _Steps | None = None

    # Life

    def boot(self, now: int) -> None:
        """Start it after power on, or after BOOTLOAD: nothing is left of before but the flash."""
        self.stop()
        self.fault = ""
        self._pages.begin()
        self._polled_at = now
        self._base = 0
        self._ram_free_to = self.memory.ram_end
        self._steps = self._spin()
        next(self._steps)

    def stop(self) -> None:
        """End it; messages that wait are lost."""
        self._steps = None
        self._queue.clear()
        self._out.clear()

    def cut_power(self, now: int) -> None:
        """End it in the middle of what it does: what is being written to the flash stays half done."""
        self.flash.cut_power(now)
        self.stop()

    def is_busy(self, now: int) -> bool:
        """Return whether the flash is being written: the module's CPU stands still, and hears nothing."""
        return now < self.flash.end

    # Messages

    def receive(self, now: int, data: bytes) -> None:
        """Receive a message."""
        self.requests += 1
        if self._steps is None or self.fault:
            self.drops["loader not running"] += 1
        elif self.requests in self.faults.lost_requests:
            self.drops["lost request"] += 1
        elif self.is_busy(now):
            self.drops["writing flash"] += 1
        elif len(self._queue) >= QUEUE:
            self.drops["loader queue full"] += 1
        else:
            if not self._queue:
                self._next_at = self._polled_at + max(1, -(-(now - self._polled_at) // _POLL)) * _POLL
            self._queue.append((self.requests, _decoded(data)))

    def poll(self, now: int) -> list[bytes]:
        """Carry out due work, and return the answers that are due: call it at `next_deadline()`."""
        while self._queue and not self.fault and now >= self._next_at:
            self._handle(*self._queue.popleft())
        answers = []
        while self._out and self._out[0][0] <= now:
            answers.append(self._out.popleft()[1])
        return answers

    def next_deadline(self) -> int | None:
        """Return when to call `poll`."""
        times = [self._out[0][0]] if self._out else []
        times += [self._next_at] if self._queue and not self.fault else []
        return min(times, default=None)

    def _handle(self, number: int, message: Loader | None) -> None:
        """Carry out one message; its answers go out as soon as the flash is written."""
        if self._steps is None:
            return
        self.flash.begin(self._next_at)
        try:
            if number in self.faults.refused:
                self._steps.throw(_Refused(0))
            else:
                self._steps.send(message)
        except (EndlessList, _AssertionFails) as error:
            self.fault = str(error)
            self._ready.clear()
        self._polled_at = self._next_at = self.flash.end
        self._out.extend((self.flash.end, data) for data in self._ready)
        self._ready.clear()

    def _answer(self, message: Loader, *, raw_name: bytes = b"") -> None:
        self.answers += 1
        if self.answers in self.faults.lost_answers:
            self.drops["lost answer"] += 1
            return
        data = bytearray(loader.encode(message))
        if raw_name:
            data[_NAME_FIELD] = raw_name
        self._ready.append(bytes(data))

    # Sessions. Each `yield` waits for the next message; a refusal ends the session.

    def _spin(self) -> _Steps:
        while True:
            try:
                match (yield):
                    case BeginLoader():
                        yield from self._written(self._load())
                    case BeginSetparam():
                        yield from self._written(self._set_parameters())
                    case BeginAppinfo():
                        yield from self._list()
                    case BeginGetparam():
                        yield from self._get_parameters()
                    case _:
                        raise _Refused(45)
            except _Refused as refusal:
                self._answer(Nack(refusal.line))

    def _written(self, session: _Steps) -> _Steps:
        """Write the last page at the end of a session, also of one that is refused."""
        self._pages.begin()
        try:
            yield from session
        except _Refused as refusal:
            self._answer(Nack(refusal.line))
        if not self._pages.flush():
            raise _AssertionFails("the flash does not keep what is written: an assertion fails at the end of a session")

    def _load(self) -> _Steps:
        self._answer(Ack())
        while True:
            match (yield):
                case LinkingSetup() as setup:
                    yield from self._load_app(setup)
                case EndLoader():
                    break
                case RemoveLast():
                    self._remove_last()
                case RemoveAll():
                    self._remove_all()
                case _:
                    raise _Refused(131)
            self._answer(Ack())
        self._answer(Ack())

    def _load_app(self, setup: LinkingSetup) -> _Steps:
        if self.apps.find(setup.name) is not None:
            raise _Refused(142)
        addresses = self._linked(setup)
        self._answer(addresses)
        outcome = yield
        if not isinstance(outcome, LinkingOutcome):
            raise _Refused(158)
        self._answer(Ack())
        while True:
            record = yield
            if not isinstance(record, IhexRecord):
                raise _Refused(168)
            if not self._take(record, setup, addresses):
                raise _Refused(173)
            self._answer(Ack())
            if record.kind == _END_OF_FILE:
                break
        if not self._pages.write(addresses.infoadr, entry(setup, addresses, outcome)):
            raise _Refused(189)

    def _list(self) -> _Steps:
        memory = self.memory
        apps = list(self.apps)
        free = self.apps.free_address()
        self._answer(
            AppinfoSummary(len(apps), free, memory.flash_start, memory.flash_end, memory.ram_start, memory.ram_end)
        )
        yield from self._acknowledged(213)
        for app in apps:
            self._answer(msgspec.structs.replace(app.setup, name="", flags=0), raw_name=app.raw_name)
            yield from self._acknowledged(231)
            self._answer(
                LinkingAddresses(app.infoadr, app.pgmadr, app.bssadr, app.dataadr, app.datapgmadr, app.nextadr)
            )
            yield from self._acknowledged(249)
            self._answer(app.outcome)
            yield from self._acknowledged(268)
        self._answer(EndAppinfo())
        yield from self._acknowledged(277)
        self._answer(Ack())

    def _get_parameters(self) -> _Steps:
        self._answer(Ack())
        while True:
            match (yield):
                case ParamRequest() as request:
                    address = self._parameter(request, (310, 315, 324))
                case EndGetparam():
                    break
                case _:
                    raise _Refused(302)
            for offset in range(0, request.length, CHUNK):
                length = min(CHUNK, request.length - offset)
                self._answer(ParamChunk(self.flash.read(address + offset, length).ljust(CHUNK, b"\0")))
                yield from self._acknowledged(344)
        self._answer(Ack())

    def _set_parameters(self) -> _Steps:
        self._answer(Ack())
        while True:
            match (yield):
                case ParamRequest() as request:
                    address = self._parameter(request, (378, 383, 392))
                case EndSetparam():
                    break
                case _:
                    raise _Refused(370)
            self._answer(Ack())
            for offset in range(0, request.length, CHUNK):
                chunk = yield
                if not isinstance(chunk, ParamChunk):
                    raise _Refused(402)
                length = min(CHUNK, request.length - offset)
                if not self._pages.write(address + offset, chunk.data[:length]):
                    raise _Refused(408 if length == CHUNK else 415)
                self._answer(Ack())
        self._answer(Ack())

    def _acknowledged(self, line: int) -> _Steps:
        if not isinstance((yield), Ack):
            raise _Refused(line)

    # Apps

    def _linked(self, setup: LinkingSetup) -> LinkingAddresses:
        """Return the addresses for an app, and hand out its RAM."""
        addresses = self.apps.linked(setup) if setup.stacklen else None
        if addresses is None:
            raise _Refused(149)
        before = self._ram_free_to
        bssadr, dataadr = self._reserve(setup.bsslen), self._reserve(setup.datalen)
        if bssadr is None or dataadr is None:
            self._ram_free_to = before
            raise _Refused(149)
        return msgspec.structs.replace(addresses, bssadr=bssadr, dataadr=dataadr)

    def _reserve(self, length: int) -> int | None:
        """Reserve RAM and return its address, 0 for an app without RAM. Return None if too little is free."""
        if not length:
            return 0
        length = -(-length // self.memory.ram_align) * self.memory.ram_align
        if self._ram_free_to - length < self.memory.ram_start:
            return None
        self._ram_free_to -= length
        return self._ram_free_to

    def _release(self, app: FlashApp) -> None:
        for length in (app.setup.bsslen, app.setup.datalen):
            self._ram_free_to += -(-length // self.memory.ram_align) * self.memory.ram_align
        self._ram_free_to = min(self._ram_free_to, self.memory.ram_end)

    def _remove_last(self) -> None:
        app = self.apps.last()
        if app is None:
            raise _Refused(115)
        self._release(app)
        self._pages.write(app.infoadr, (~SIGNATURE % ADDRESSES).to_bytes(4, "little"))

    def _remove_all(self) -> None:
        for app in self.apps:
            self._release(app)
        erased = bytes([ERASED]) * (self.memory.flash_end - self.memory.flash_start)
        if not self._pages.write(self.memory.flash_start, erased):
            raise _AssertionFails("the flash cannot be erased: an assertion fails")

    def _take(self, record: IhexRecord, setup: LinkingSetup, addresses: LinkingAddresses) -> bool:
        """Carry out a record of an Intel hex file. Return whether it is valid."""
        if record.count > len(record.data) or record.checksum != _checksum(record):
            return False
        if record.kind == _DATA:
            start = (self._base + record.offset) % ADDRESSES
            parts = ((addresses.pgmadr, setup.pgmlen), (addresses.datapgmadr, setup.datalen))
            inside = any(adr and adr <= start and start + record.count <= adr + length for adr, length in parts)
            return inside and self._pages.write(start, record.data[: record.count])
        if (record.kind, record.count) not in _OTHER_RECORDS or record.offset:
            return False
        if record.kind in _BASES:
            high, low = _BASES[record.kind]
            self._base = record.data[0] << high | record.data[1] << low
        return True

    def _parameter(self, request: ParamRequest, lines: tuple[int, int, int]) -> int:
        """Return the address of a parameter. `lines`: of the refusals of length 0, a name, and a wrong range."""
        if not request.length:
            raise _Refused(lines[0])
        app = self.apps.find(request.appname)
        if app is None:
            raise _Refused(lines[1])
        address = app.flagsadr
        if request.offset != FLAGS_WORD:
            address = (app.outcome.cfgadr + request.offset) % ADDRESSES
        parts = ((app.outcome.cfgadr, app.outcome.cfglen), (app.flagsadr, FLAGS_SIZE))
        if not any(adr <= address and address + request.length <= adr + length for adr, length in parts):
            raise _Refused(lines[2])
        return address


_DATA, _END_OF_FILE = 0, 1
_OTHER_RECORDS = {(1, 0), (2, 2), (3, 4), (4, 2), (5, 4)}  # kinds of records, and the count that each must have
_BASES = {2: (12, 4), 4: (24, 16)}  # kinds that set the base: bits by which its two bytes are shifted


class _Refused(Exception):
    """The loader refuses a message, at this line of its source."""

    def __init__(self, line: int) -> None:
        self.line = line


class _AssertionFails(Exception):
    """An assertion of the firmware fails, and the module halts."""


def _checksum(record: IhexRecord) -> int:
    head = (record.count, record.offset >> 8, record.offset & 0xFF, record.kind)
    return -(sum(head) + sum(record.data[: record.count])) & 0xFF


def _decoded(data: bytes) -> Loader | None:
    """Return the message, None for one of an unknown type: the loader never expects that."""
    try:
        return loader.decode(data)
    except (UnknownType, DecodeError):
        return None
