"""What is needed of an ELF file: its sections in the three parts of an app, its symbols and its relocations.

    program   .text*, then all that is constant, then .init_array* and .fini_array*
    data      .data*
    bss       .bss*

Tables for exceptions and debugging are left out: nothing unwinds an app.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from r2p.errors import Error
from r2p.loader.image import SIZE_MAX, AppFileError

Part = Literal["program", "data", "bss"]

ARRAYS = ("SHT_PREINIT_ARRAY", "SHT_INIT_ARRAY", "SHT_FINI_ARRAY")
"""The types of sections with lists of constructors and destructors, in their order in memory."""

_WRITE, _ALLOCATED, _EXECUTABLE = 1, 2, 4  # flags of a section
_LEFT_OUT = (".ARM.exidx", ".ARM.extab", ".eh_frame")
_LATEST = 1 << 16  # the priority of constructors without one
_SECTIONS_MAX = 10_000
_SYMBOLS_MAX = 1_000_000

T = TypeVar("T")


class ElfSection(msgspec.Struct):
    """A section. `address` is its place in an executable, `offset` the one in its part that linking gives it."""

    name: str
    kind: str
    part: Part
    align: int
    size: int
    data: bytes
    address: int
    rank: tuple[int, int, int]
    offset: int = 0


class ElfSymbol(msgspec.Struct, frozen=True):
    """A symbol. `section` is a number, or SHN_UNDEF, SHN_ABS or SHN_COMMON."""

    name: str
    value: int
    size: int
    section: int | str
    binding: str


class ElfRelocation(msgspec.Struct, frozen=True):
    """A place in a section that depends on a symbol."""

    section: int
    offset: int
    kind: int
    symbol: int


class ElfContent(msgspec.Struct):
    """An ELF file."""

    relocatable: bool
    sections: dict[int, ElfSection]
    symbols: list[ElfSymbol]
    relocations: list[ElfRelocation]

    def of(self, part: Part) -> list[ElfSection]:
        """Return the sections of a part, in the order in which they are to be linked."""
        return sorted((each for each in self.sections.values() if each.part == part), key=lambda each: each.rank)

    def find(self, name: str) -> ElfSymbol | None:
        """Return the symbol of this name that is defined in one of the sections."""
        return next((each for each in self.symbols if each.name == name and each.section in self.sections), None)


def read_content(path: Path) -> ElfContent:
    """Read the file of an app. Raises AppFileError, and Error without pyelftools."""
    return _with_elf(path, _content)


def read_symbols(path: Path) -> dict[str, int]:
    """Read the addresses of all global symbols of a firmware. Raises AppFileError, and Error without pyelftools."""
    return _with_elf(path, _global_symbols)


def _with_elf(path: Path, read: Callable[[Any], T]) -> T:
    try:
        from elftools.elf.elffile import ELFFile
    except ImportError as error:
        raise Error("ELF files need pyelftools: install r2p[elf]; HEX files need nothing else") from error
    try:
        with path.open("rb") as file:
            elf = ELFFile(file)
            _check_machine(elf)
            return read(elf)
    except OSError as error:
        raise AppFileError(f"can't read {path}: {error.strerror}") from error
    except AppFileError as error:
        raise AppFileError(f"{path}: {error}") from error
    except Exception as error:
        raise AppFileError(f"{path} is not a valid ELF file: {error}") from error


def _check_machine(elf: Any) -> None:
    if elf["e_machine"] != "EM_ARM" or elf.elfclass != 32 or not elf.little_endian:
        raise AppFileError("it is not for ARM with 32 bits, little-endian: compile it with arm-none-eabi-gcc")
    if elf.num_sections() > _SECTIONS_MAX:
        raise AppFileError(f"it has {elf.num_sections()} sections")


def _content(elf: Any) -> ElfContent:
    if elf["e_type"] not in ("ET_REL", "ET_EXEC"):
        raise AppFileError(f"it is neither relocatable nor executable, but {elf['e_type']}: link it by ld -r")
    content = ElfContent(elf["e_type"] == "ET_REL", {}, [], [])
    tables, size = [], 0
    for index, each in enumerate(elf.iter_sections()):
        kind = each["sh_type"]
        if kind == "SHT_SYMTAB":
            content.symbols = _symbols(each)
        elif kind in ("SHT_REL", "SHT_RELA"):
            tables.append(each)
        elif each["sh_flags"] & _ALLOCATED and each.data_size and not each.name.startswith(_LEFT_OUT):
            if (size := size + each.data_size) > SIZE_MAX:
                raise AppFileError(f"its sections up to {each.name} have {size} bytes, more than any module has")
            content.sections[index] = _section(each, index)
    if content.relocatable:
        content.relocations = [one for each in tables for one in _relocations(each, content)]
    return content


def _section(section: Any, index: int) -> ElfSection:
    name, kind, size = section.name, section["sh_type"], section.data_size
    writable = section["sh_flags"] & (_WRITE | _EXECUTABLE) == _WRITE and kind not in ARRAYS
    part: Part = "bss" if kind == "SHT_NOBITS" else "data" if writable else "program"
    data = b"" if part == "bss" else section.data()
    if part != "bss" and len(data) != size:
        raise AppFileError(f"{name} is cut short")
    align = max(1, section.data_alignment)
    return ElfSection(name, kind, part, align, size, data, section["sh_addr"], _rank(section, index))


def _rank(section: Any, index: int) -> tuple[int, int, int]:
    """Return what sections are sorted by: code, constants, then lists of constructors by their priority."""
    kind = section["sh_type"]
    if kind in ARRAYS:
        priority = section.name.rpartition(".")[2]
        return 2 + ARRAYS.index(kind), int(priority) if priority.isdecimal() else _LATEST, index
    return int(not section["sh_flags"] & _EXECUTABLE), 0, index


def _symbols(table: Any) -> list[ElfSymbol]:
    if table.num_symbols() > _SYMBOLS_MAX:
        raise AppFileError(f"it has {table.num_symbols()} symbols")
    return [
        ElfSymbol(each.name, each["st_value"], each["st_size"], each["st_shndx"], each["st_info"]["bind"])
        for each in table.iter_symbols()
    ]


def _relocations(table: Any, content: ElfContent) -> list[ElfRelocation]:
    target = table["sh_info"]
    if target not in content.sections:  # of debugging, or left out
        return []
    if content.sections[target].part == "bss":
        raise AppFileError(f"{table.name} changes {content.sections[target].name}, which has no content")
    if table.is_RELA():
        raise AppFileError(f"{table.name} has explicit addends, which ARM does not use")
    found = [
        ElfRelocation(target, each["r_offset"], each["r_info_type"], each["r_info_sym"])
        for each in table.iter_relocations()
    ]
    if any(each.symbol >= len(content.symbols) for each in found):
        raise AppFileError(f"{table.name} refers to a symbol that does not exist")
    return found


def _global_symbols(elf: Any) -> dict[str, int]:
    table = elf.get_section_by_name(".symtab")
    if table is None:
        raise AppFileError("it has no symbols: they were stripped")
    return {
        each.name: each.value
        for each in _symbols(table)
        if each.binding in ("STB_GLOBAL", "STB_WEAK") and each.section not in ("SHN_UNDEF", "SHN_COMMON")
    }
