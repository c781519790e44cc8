"""Apps in ELF files. A relocatable one is linked here, against the symbols of the module's firmware.

`arm-none-eabi-ld -r` makes one relocatable file of all that an app consists of. Its calls of the firmware are undefined
symbols in it; the firmware's own ELF file has their addresses. An executable file is linked already.
"""

from pathlib import Path

import msgspec

from r2p.codecs.loader import AppinfoSummary, LinkingAddresses, LinkingOutcome
from r2p.loader.elf import ElfContent, ElfRelocation, ElfSection, ElfSymbol, Part, read_content, read_symbols
from r2p.loader.image import (
    SIZE_MAX,
    AppDescription,
    AppFileError,
    AppImage,
    FixedApp,
    LayoutError,
    LinkedApp,
    check_outcome,
    padded,
    rounded,
)
from r2p.loader.relocations import relocate

CONFIG_SECTION = ".config"
"""The section that is the app's config area, unless the description names another place."""
MAINS = ("app_main", "main")
"""Symbols of the app's main function, unless the description names another one."""

_POINTER = 4  # bytes

_Bases = dict[Part, int]


def read_elf(path: Path, description: AppDescription) -> AppImage:
    """Read an app. Raises AppFileError, and Error without pyelftools."""
    content = read_content(path)
    if content.relocatable:
        return RelocatableApp(path, description, content)
    return _read_executable(path, description, content)


class RelocatableApp(AppImage):
    """An app that is linked for whatever addresses the loader gives it."""

    def __init__(self, path: Path, description: AppDescription, content: ElfContent) -> None:
        """Lay it out. Raises AppFileError if it refers to something that neither it nor the firmware has."""
        sizes = (_lay_out(content, "program"), _lay_out(content, "data"), _lay_out(content, "bss"))
        self._commons, bss = _lay_out_commons(content, sizes[2])
        super().__init__(path, description, (sizes[0], sizes[1], bss))
        self._content = content
        self._description = description
        self._main = _main_symbol(path, description, content)
        self._firmware = self._find_in_firmware()

    def _find_in_firmware(self) -> dict[str, int]:
        """Return the addresses of what it uses of the firmware."""
        used = {self._content.symbols[each.symbol] for each in self._content.relocations}
        undefined = {each.name: each.binding for each in used if each.section == "SHN_UNDEF" and each.name}
        if not undefined:
            return {}
        given = self._description.symbols
        known = {} if given is None else read_symbols(self.path.parent / given)
        missing = sorted(name for name, binding in undefined.items() if name not in known and binding != "STB_WEAK")
        if missing:
            lacks = "which are in no file: give the ELF file of the firmware by --symbols"
            lacks = lacks if given is None else f"which {given} does not have: is it of this version of the firmware?"
            raise AppFileError(f"{self.path} uses {', '.join(missing)}, {lacks}")
        return {name: known[name] for name in undefined if name in known}

    def check(self, memory: AppinfoSummary) -> None:
        for name, address in self._firmware.items():
            if memory.pgmstartadr <= address < memory.pgmendadr:
                raise LayoutError(
                    f"{self._description.symbols} is not of the firmware of this module: {name} at {address:#010x} "
                    "would be in the memory for apps"
                )

    def link(self, addresses: LinkingAddresses) -> LinkedApp:
        bases: _Bases = {"program": addresses.pgmadr, "data": addresses.dataadr, "bss": addresses.bssadr}
        for each in self._content.sections.values():
            self._check_alignment(each, bases[each.part])
        images = {"program": _image(self._content, "program"), "data": _image(self._content, "data")}
        for relocation in self._content.relocations:
            self._relocate(relocation, images, bases)
        program, data = padded(bytes(images["program"])), padded(bytes(images["data"]))
        outcome = self._outcome(bases)
        check_outcome(self.path, outcome, range(addresses.pgmadr, addresses.pgmadr + len(program)))
        return LinkedApp(program, addresses.pgmadr, data, addresses.datapgmadr, outcome)

    def _check_alignment(self, section: ElfSection, base: int) -> None:
        if base % section.align:
            raise LayoutError(
                f"{self.path}: {section.name} is aligned to {section.align} bytes, and its place begins at "
                f"{base:#010x}: use a smaller alignment"
            )

    def _relocate(self, relocation: ElfRelocation, images: dict[str, bytearray], bases: _Bases) -> None:
        section = self._content.sections[relocation.section]
        symbol = self._content.symbols[relocation.symbol]
        offset = section.offset + relocation.offset
        try:
            if relocation.offset >= section.size:
                raise ValueError("the place is outside of its section")
            relocate(
                relocation.kind, images[section.part], offset, self._value(symbol, bases), bases[section.part] + offset
            )
        except ValueError as error:
            place = f"{section.name} + {relocation.offset:#x} ({symbol.name or 'no name'})"
            raise LayoutError(f"{self.path}: {place}: {error}") from error

    def _value(self, symbol: ElfSymbol, bases: _Bases) -> int | None:
        """Return the address of a symbol; None for a weak one that is defined nowhere."""
        if isinstance(symbol.section, int):
            section = self._content.sections.get(symbol.section)
            if section is None:
                raise ValueError("its section is left out of an app")
            return bases[section.part] + section.offset + symbol.value
        match symbol.section:
            case "SHN_ABS":
                return symbol.value
            case "SHN_COMMON":
                return bases["bss"] + self._commons[symbol.name]
            case _:
                return self._firmware.get(symbol.name, None if symbol.name else 0)

    def _outcome(self, bases: _Bases) -> LinkingOutcome:
        main = self._value(self._main, bases)
        assert main is not None
        sections = self._content.sections
        places = {index: bases[each.part] + each.offset for index, each in sections.items()}
        config = self._config(places, bases)
        return _outcome(self._content, self._description, main, config, places)

    def _config(self, places: dict[int, int], bases: _Bases) -> tuple[int, int]:
        wanted = self._description.config
        if isinstance(wanted, str):
            symbol = self._content.find(wanted)
            address = None if symbol is None else self._value(symbol, bases)
            if symbol is None or address is None:
                raise AppFileError(f"{self.path} does not define {wanted}, which is to be its config area")
            return address, symbol.size
        if wanted is not None:
            raise AppFileError(f"{self.path} has no addresses yet: name the symbol or use the section {CONFIG_SECTION}")
        return _config_section(self._content, places)


def _read_executable(path: Path, description: AppDescription, content: ElfContent) -> FixedApp:
    program, data = _linked_image(path, content, "program"), _linked_image(path, content, "data")
    bss = _extent(path, content, "bss")
    described = msgspec.structs.replace(
        description, data=(data[0], len(data[1])), bss=(bss.start, len(bss)) if bss else (0, 0)
    )
    main = description.main if isinstance(description.main, int) else _main_symbol(path, description, content).value
    places = {index: each.address for index, each in content.sections.items()}
    outcome = _outcome(content, description, main, _linked_config(path, description, content, places), places)
    return FixedApp(path, described, program, data[1], outcome)


def _linked_config(
    path: Path, description: AppDescription, content: ElfContent, places: dict[int, int]
) -> tuple[int, int]:
    wanted = description.config
    if isinstance(wanted, str):
        symbol = content.find(wanted)
        if symbol is None:
            raise AppFileError(f"{path} does not define {wanted}, which is to be its config area")
        return symbol.value, symbol.size
    return _config_section(content, places) if wanted is None else wanted


def _linked_image(path: Path, content: ElfContent, part: Part) -> tuple[int, bytes]:
    """Return the address and the bytes of a part of an executable."""
    extent = _extent(path, content, part)
    image = bytearray(len(extent))
    for each in content.of(part):
        begin = each.address - extent.start
        image[begin : begin + each.size] = each.data
    return extent.start, bytes(image)


def _extent(path: Path, content: ElfContent, part: Part) -> range:
    """Return the addresses of a part of an executable."""
    sections = content.of(part)
    begin = min((each.address for each in sections), default=0)
    end = max((each.address + each.size for each in sections), default=0)
    if end - begin > SIZE_MAX:
        raise AppFileError(f"{path}: the sections of its {part} are {end - begin} bytes apart, more than a module has")
    return range(begin, end)


def _main_symbol(path: Path, description: AppDescription, content: ElfContent) -> ElfSymbol:
    names = MAINS if description.main is None else (str(description.main),)
    for name in names:
        if (symbol := content.find(name)) is not None:
            return symbol
    raise AppFileError(f'{path} defines no function {" or ".join(names)}: name its main function by main = "..."')


def _config_section(content: ElfContent, places: dict[int, int]) -> tuple[int, int]:
    """Return the address and the length of the section for the config area, or 0 and 0."""
    found = ((places[index], each.size) for index, each in content.sections.items() if each.name == CONFIG_SECTION)
    return next(found, (0, 0))


def _outcome(
    content: ElfContent, description: AppDescription, main: int, config: tuple[int, int], places: dict[int, int]
) -> LinkingOutcome:
    """Return what the loader is to know."""
    constructors, ctors = _pointers(content, "SHT_INIT_ARRAY", places) or description.constructors
    destructors, dtors = _pointers(content, "SHT_FINI_ARRAY", places) or description.destructors
    return LinkingOutcome(
        mainadr=main,
        cfgadr=config[0],
        cfglen=config[1],
        ctorsadr=constructors,
        ctorslen=ctors,
        dtorsadr=destructors,
        dtorslen=dtors,
    )


def _pointers(content: ElfContent, kind: str, places: dict[int, int]) -> tuple[int, int] | None:
    """Return the address and the number of the pointers in sections of a kind, all priorities one behind the other."""
    lists = [(places[index], each.size) for index, each in content.sections.items() if each.kind == kind]
    return (min(lists)[0], sum(size for _, size in lists) // _POINTER) if lists else None


def _lay_out(content: ElfContent, part: Part) -> int:
    """Give the sections of a part their places; return its length."""
    end = 0
    for each in content.of(part):
        each.offset = rounded(end, each.align)
        end = each.offset + each.size
    return end


def _lay_out_commons(content: ElfContent, end: int) -> tuple[dict[str, int], int]:
    """Return the places of common symbols behind the .bss, by name, and the length of both."""
    places: dict[str, int] = {}
    for each in content.symbols:
        if each.section == "SHN_COMMON":
            places[each.name] = rounded(end, max(1, each.value))  # the value of one is its alignment
            end = places[each.name] + each.size
    return places, end


def _image(content: ElfContent, part: Part) -> bytearray:
    image = bytearray()
    for each in content.of(part):
        image += bytes(each.offset - len(image)) + each.data
    return image
