"""What is loaded: an app with its lengths, and its code once the loader has said where to put it.

`FixedApp` is linked already, as an Intel HEX file always is; it fits only a module that gives it just these addresses.
`r2p.loader.linking` has `RelocatableApp`, which is linked for any. `files.py` reads both.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from r2p.codecs.loader import (
    CHUNK,
    FLAG_ENABLED,
    AppinfoSummary,
    IhexRecord,
    LinkingAddresses,
    LinkingOutcome,
    LinkingSetup,
)
from r2p.loader.session import LoaderError

STACK_MIN = 512
"""Bytes that an app's thread needs at least: its stack, its thread structure and the interrupt stack."""
NAME_MAX = 8
"""Characters of an app's name."""
ENTRY_SIZE = 80
"""Bytes of an app's entry, in front of its program."""
GRAIN = 16
"""Program and data in flash begin at multiples of this many bytes."""
WORD = 4
"""Bytes to which program and data are filled up: flash is written by half words at least."""
SIZE_MAX = 1 << 20
"""Bytes of an app at most; a module's flash is far smaller."""

_DATA, _END_OF_FILE, _BASE = 0, 1, 4  # types of records
_ERASED = b"\xff"
_PAGE = 1 << 16  # bytes that records reach from one base


U32 = Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]
"""An address or a length."""


class AppFileError(LoaderError, ValueError):
    """A file that is not an app, or lacks something: wrong whatever the module is."""


class LayoutError(LoaderError):
    """An app that does not fit the addresses of the module: link it for these."""


class AppDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a file with code does not say: the content of the TOML file beside it.

    Addresses are numbers (`0x0800F451`); in an ELF file `main` and `config` may be symbols as well. `bss` and `data`
    are [address, length] in RAM, `config` is [address, length] in the program, `constructors` and `destructors` are
    [address, number of pointers]. `stack` is the whole working area of the app's thread in bytes.
    """

    name: str | None = None
    stack: U32 | None = None
    enabled: bool = False
    module: str | None = None
    main: U32 | str | None = None
    config: tuple[U32, U32] | str | None = None
    bss: tuple[U32, U32] = (0, 0)
    data: tuple[U32, U32] = (0, 0)
    constructors: tuple[U32, U32] = (0, 0)
    destructors: tuple[U32, U32] = (0, 0)
    symbols: str | None = None


class LinkedApp(msgspec.Struct, frozen=True):
    """The code of an app for certain addresses: what goes to flash, and where."""

    program: bytes
    program_address: int
    data: bytes
    data_address: int
    outcome: LinkingOutcome

    def records(self) -> list[IhexRecord]:
        """Return the records that write all of it, the end of the file last."""
        records: list[IhexRecord] = []
        base = None
        for address, data in ((self.program_address, self.program), (self.data_address, self.data)):
            for begin, chunk in _chunks(address, data):
                if begin // _PAGE != base:
                    base = begin // _PAGE
                    records.append(record(_BASE, 0, base.to_bytes(2, "big")))
                records.append(record(_DATA, begin % _PAGE, chunk))
        return [*records, record(_END_OF_FILE, 0, b"")]

    @property
    def config(self) -> bytes:
        """The content of the config area."""
        begin = self.outcome.cfgadr - self.program_address
        return self.program[begin : begin + self.outcome.cfglen] if self.outcome.cfglen else b""


class AppImage(ABC):
    """An app that can be loaded."""

    program_address: int | None = None
    """The only address that the program can have; None: it can have any."""

    def __init__(self, path: Path, description: AppDescription, sizes: tuple[int, int, int]) -> None:
        """`sizes`: bytes of program, data and bss. Raises AppFileError for a description that can't be right."""
        self.path = path
        self.name = _checked_name(path, description)
        self.enabled = description.enabled
        """Whether it is to start with the module."""
        self.module = description.module
        """The only module that it is for; None: any."""
        self.stack = _checked_stack(path, description)
        program, data, self.bss_size = sizes
        self.program_size, self.data_size = rounded(program, WORD), rounded(data, WORD)
        if not program:
            raise AppFileError(f"{path}: it has no program")
        if sum(sizes) > SIZE_MAX:
            raise AppFileError(f"{path}: its {sum(sizes)} bytes are more than any module has")

    @property
    def setup(self) -> LinkingSetup:
        """The message that announces it to a loader."""
        return LinkingSetup(
            pgmlen=self.program_size,
            bsslen=self.bss_size,
            datalen=self.data_size,
            stacklen=self.stack,
            name=self.name,
            flags=FLAG_ENABLED if self.enabled else 0,
        )

    @property
    def flash(self) -> int:
        """Bytes of flash that it needs."""
        return ENTRY_SIZE + rounded(self.program_size) + rounded(self.data_size)

    @abstractmethod
    def link(self, addresses: LinkingAddresses) -> LinkedApp:
        """Return its code for these addresses. Raises LayoutError if that is not possible."""

    def check(self, memory: AppinfoSummary) -> None:
        """Raise LayoutError if it can't be for a module with this memory."""


class FixedApp(AppImage):
    """An app that is linked for certain addresses: a HEX file, or an executable ELF file."""

    def __init__(
        self, path: Path, description: AppDescription, program: tuple[int, bytes], data: bytes, outcome: LinkingOutcome
    ) -> None:
        """`program`: its address and content; `data`: the content of .data. Raises AppFileError."""
        super().__init__(path, description, (len(program[1]), len(data), description.bss[1]))
        self.program_address, self._program = program[0], padded(program[1])
        self._data = padded(data)
        self._ram = {".data": description.data[0], ".bss": description.bss[0]}
        self._outcome = outcome
        check_outcome(path, outcome, range(program[0], program[0] + self.program_size))

    def link(self, addresses: LinkingAddresses) -> LinkedApp:
        given = {"its program": (self.program_address, addresses.pgmadr)}
        given |= {".data": (self._ram[".data"], addresses.dataadr)} if self.data_size else {}
        given |= {".bss": (self._ram[".bss"], addresses.bssadr)} if self.bss_size else {}
        wrong = [f"{what} {has:#010x}, not {wants:#010x}" for what, (has, wants) in given.items() if has != wants]
        if wrong:
            raise layout_error(self.path, wrong)
        return LinkedApp(self._program, addresses.pgmadr, self._data, addresses.datapgmadr, self._outcome)


def layout_error(path: Path, wrong: list[str]) -> LayoutError:
    """Return the error for a file that is linked for other addresses; `wrong` says for which."""
    return LayoutError(
        f"{path} is linked for another layout: {'; '.join(wrong)}: link it again for these addresses, or load the "
        "relocatable ELF file (ld -r), which fits any"
    )


def check_outcome(path: Path, outcome: LinkingOutcome, program: range) -> None:
    """Raise AppFileError unless main, config area and lists of constructors lie in the program."""
    if not outcome.mainadr & 1:
        raise AppFileError(f"{path}: main {outcome.mainadr:#010x} is not a Thumb function: its address must be odd")
    parts = {
        "main": (outcome.mainadr - 1, 2),
        "config": (outcome.cfgadr, outcome.cfglen),
        "constructors": (outcome.ctorsadr, 4 * outcome.ctorslen),
        "destructors": (outcome.dtorsadr, 4 * outcome.dtorslen),
    }
    for what, (begin, length) in parts.items():
        if length and not (program.start <= begin and length >= 0 and begin + length <= program.stop):
            where = f"{program.start:#010x} to {program.stop:#010x}"
            raise AppFileError(f"{path}: {what} at {begin:#010x} ({length} bytes) is not in its program, {where}")


def _checked_name(path: Path, description: AppDescription) -> str:
    name = path.stem if description.name is None else description.name
    if not (0 < len(name) <= NAME_MAX and name.isascii() and name.isprintable() and " " not in name):
        raise AppFileError(
            f"{path}: {name!r} can't be the name of an app, which has 1 to {NAME_MAX} ASCII characters without blanks: "
            "give another one by --name or as `name` of its description"
        )
    return name


def _checked_stack(path: Path, description: AppDescription) -> int:
    if description.stack is None:
        beside = path.with_suffix(".toml").name
        raise AppFileError(f"{path}: how much stack does it need? Write to {beside} stack = 1024, or give --stack 1024")
    if description.stack < STACK_MIN:
        raise AppFileError(
            f"{path}: a stack of {description.stack} bytes is too small: it holds the thread and its interrupts as "
            f"well, and with less than {STACK_MIN} the module halts at each start"
        )
    return description.stack


def record(kind: int, offset: int, data: bytes) -> IhexRecord:
    """Return a record of an Intel HEX file with its checksum."""
    total = len(data) + (offset >> 8) + (offset & 0xFF) + kind + sum(data)
    return IhexRecord(count=len(data), offset=offset, kind=kind, data=data.ljust(CHUNK, b"\0"), checksum=-total & 0xFF)


def rounded(length: int, grain: int = GRAIN) -> int:
    """Return a length as a multiple of `grain` bytes; by default what it takes in flash."""
    return -(-length // grain) * grain


def padded(image: bytes) -> bytes:
    """Return the content of a part, as long as whole words."""
    return image.ljust(rounded(len(image), WORD), _ERASED)


def _chunks(address: int, data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield parts of at most 16 bytes with their addresses; none crosses the reach of its base."""
    begin = 0
    while begin < len(data):
        room = min(CHUNK, _PAGE - (address + begin) % _PAGE)
        yield address + begin, data[begin : begin + room]
        begin += room
