"""The files of an app: its code, as Intel HEX or ELF, and beside it a TOML file with what that does not say."""

import tomllib
from pathlib import Path
from typing import Any

import msgspec

from r2p.codecs.loader import LinkingOutcome
from r2p.loader.image import SIZE_MAX, AppDescription, AppFileError, AppImage, FixedApp
from r2p.loader.linking import read_elf

_ELF = b"\x7fELF"
_ERASED = 0xFF  # what gaps of a HEX file are filled with


def read_app(path: Path, given: dict[str, Any] | None = None) -> AppImage:
    """Read an app from a HEX or an ELF file, and its description from the TOML file of the same name, if there is one.

    `given` replaces what the description says. Raises AppFileError for files that are not as they should be, and Error
    if a package for their format is missing.
    """
    try:
        with path.open("rb") as file:
            is_elf = file.read(len(_ELF)) == _ELF
    except OSError as error:
        raise AppFileError(f"can't read {path}: {error.strerror}") from error
    description = _read_description(path, given or {})
    return read_elf(path, description) if is_elf else _read_hex(path, description)


def _read_description(path: Path, given: dict[str, Any]) -> AppDescription:
    beside = path.with_suffix(".toml")
    content: dict[str, Any] = {}
    try:
        if beside.exists():
            content = tomllib.loads(beside.read_text("utf-8"))
        return msgspec.convert(content | given, AppDescription)
    except OSError as error:
        raise AppFileError(f"can't read {beside}: {error.strerror}") from error
    except msgspec.ValidationError as error:
        known = ", ".join(AppDescription.__struct_fields__)
        raise AppFileError(f"{beside}: {error}; an app's description has {known}") from error
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, numbers of thousands of digits, deep arrays
        raise AppFileError(f"{beside}: {error}") from error


def _read_hex(path: Path, description: AppDescription) -> FixedApp:
    from intelhex import IntelHex, IntelHexError

    content = IntelHex()
    content.padding = _ERASED
    try:
        content.loadhex(str(path))
    except (IntelHexError, UnicodeDecodeError) as error:
        raise AppFileError(f"{path} is not an Intel HEX file: {error}") from error
    begin, end = content.minaddr(), content.maxaddr()
    if begin is None or end is None:
        raise AppFileError(f"{path}: it has no data")
    length = end + 1 - begin
    if length > SIZE_MAX:
        raise AppFileError(f"{path}: its records are {length} bytes apart, more than any module has")
    data_size = description.data[1]
    if not 0 <= data_size < length:
        raise AppFileError(f"{path}: of its {length} bytes, {data_size} are to be those of .data: correct data")
    image = bytes(content.tobinarray(start=begin, size=length))
    split = length - data_size
    end_of_program = max(min(stop - begin, split) for start, stop in content.segments() if start - begin < split)
    program = begin, image[:end_of_program]
    return FixedApp(path, description, program, image[split:], _described_outcome(path, description))


def _described_outcome(path: Path, description: AppDescription) -> LinkingOutcome:
    main, config = description.main, description.config or (0, 0)
    if not isinstance(main, int) or isinstance(config, str):
        needed = "address of its main function: main = 0x0800F451"
        raise AppFileError(f"{path}: a HEX file has no symbols: write to {path.with_suffix('.toml').name} the {needed}")
    return LinkingOutcome(
        mainadr=main,
        cfgadr=config[0],
        cfglen=config[1],
        ctorsadr=description.constructors[0],
        ctorslen=description.constructors[1],
        dtorsadr=description.destructors[0],
        dtorslen=description.destructors[1],
    )
