"""Apps in files: what is read, how it is linked, and which files are refused."""

from __future__ import annotations

import io
import shutil
import struct
import sys
from typing import TYPE_CHECKING, Any

import pytest
from elftools.elf.elffile import ELFFile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import r2p
from r2p.codecs.loader import AppinfoSummary, LinkingAddresses
from r2p.loader.checks import expected_addresses
from r2p.loader.files import read_app
from r2p.loader.image import AppFileError, AppImage, LayoutError, LinkedApp
from r2p.loader.relocations import relocate
from r2p.loader.session import LoaderError
from tests.vectors import GOLDEN

if TYPE_CHECKING:
    from pathlib import Path

APPS = GOLDEN / "apps"
EMPTY = AppinfoSummary(0, 0x0800F400, 0x0800F400, 0x08020000, 0x20000000, 0x20005000)
LATER = AppinfoSummary(0, 0x0800F490, 0x0800F400, 0x08020000, 0x20000000, 0x20004F00)


def addresses(app: AppImage, memory: AppinfoSummary = EMPTY) -> LinkingAddresses:
    (expected,) = expected_addresses([app], memory, 8)
    return expected


def link(name: str, memory: AppinfoSummary = EMPTY) -> LinkedApp:
    app = read_app(APPS / name)
    return app.link(addresses(app, memory))


@pytest.mark.golden
@pytest.mark.parametrize("name", ["linked.elf", "linked.hex"])
def test_an_app_is_linked_as_by_gnu_ld(name: str) -> None:
    ours, theirs = link("blink.elf"), link(name)
    assert ours.program == theirs.program
    assert ours == theirs
    assert ours.records() == theirs.records()
    assert ours.config == b"\xf4\x01\0\0\xfd\xff\xff\xffblink".ljust(24, b"\0")


def test_records_write_all_of_it_and_no_record_crosses_the_reach_of_its_base() -> None:
    memory = {}
    base = 0
    app = LinkedApp(bytes(range(250)), 0x0800FFF8, b"data", 0x080100F8, link("blink.elf").outcome)
    *records, end = app.records()
    for each in records:
        data = each.data[: each.count]
        assert (each.count + (each.offset >> 8) + each.offset + each.kind + sum(data) + each.checksum) % 256 == 0
        if each.kind == 4:
            base = int.from_bytes(data, "big") << 16
        else:
            memory.update({base + each.offset + i: byte for i, byte in enumerate(data)})
            assert each.offset + each.count <= 0x10000
    assert bytes(memory[0x0800FFF8 + i] for i in range(250)) == app.program
    assert bytes(memory[0x080100F8 + i] for i in range(4)) == b"data"
    assert (end.kind, end.count) == (1, 0)


@pytest.mark.parametrize("name", ["linked.elf", "linked.hex"])
def test_a_linked_app_fits_one_place_only(name: str) -> None:
    with pytest.raises(LayoutError, match=r"another layout: its program 0x0800f450, not 0x0800f4e0; .data 0x20004fb0"):
        link(name, LATER)
    assert link("blink.elf", LATER).outcome.mainadr == 0x0800F501 + 0x90


@pytest.fixture
def copy(tmp_path: Path) -> Any:
    """Copy the files of an app, with other words in its description."""

    def make(name: str, description: str | None = None, /, **changes: str) -> Path:
        for each in APPS.iterdir():
            shutil.copy(each, tmp_path)
        path = tmp_path / name
        if not path.is_file():
            return path
        beside = path.with_suffix(".toml")
        text = beside.read_text() if description is None else description
        for old, new in changes.items():
            text = "\n".join(new if line.startswith(f"{old} =") else line for line in text.splitlines())
        beside.write_text(text)
        return path

    return make


@pytest.mark.parametrize(
    ("name", "changes", "text"),
    [
        (
            "linked.hex",
            {"stack": ""},
            r"how much stack does it need\? Write to linked.toml stack = 1024, or give --sta",
        ),
        ("linked.hex", {"stack": "stack = 511"}, r"a stack of 511 bytes is too small.*less than 512"),
        ("linked.hex", {"main": ""}, r"a HEX file has no symbols: write to linked.toml the address of its main"),
        ("linked.hex", {"main": "main = 0x0800F500"}, "is not a Thumb function: its address must be odd"),
        ("linked.hex", {"main": "main = 0x08010001"}, "main at 0x08010000 .* is not in its program"),
        ("linked.hex", {"config": "config = [0x0800F598, 2400]"}, "config at 0x0800f598 .* is not in its program"),
        ("linked.hex", {"data": "data = [0x20004FB0, 4000]"}, "of its 372 bytes, 4000 are to be those of .data"),
        ("linked.hex", {"name": 'name = "ninechars"'}, "'ninechars' can't be the name of an app"),
        ("linked.hex", {"bss": "bas = 1"}, "unknown field `bas`; an app's description has name, stack"),
        ("linked.hex", {"bss": "bss = [0, -8]"}, r"linked\.toml: Expected `int` >= 0 - at `\$\.bss"),
        ("linked.hex", {"bss": "bss ="}, "linked.toml: Invalid value"),
        ("blink.elf", {"symbols": ""}, "uses r2p_near, r2p_publish, r2p_sleep, state_of_firmware, ticks, which are in"),
        ("blink.elf", {"symbols": 'symbols = "blink.elf"'}, "which blink.elf does not have"),
        ("blink.elf", {"symbols": 'symbols = "lost.elf"'}, "can't read .*lost.elf: No such file"),
        ("blink.elf", {"stack": 'stack = 1024\nmain = "start"'}, "defines no function start"),
        ("blink.elf", {"stack": 'stack = 1024\nconfig = "cfg"'}, "does not define cfg"),
        ("blink.elf", {"stack": "stack = " + "9" * 5000}, "blink.toml: Exceeds the limit"),
        ("blink.elf", {"stack": "stack = " + "[" * 9000}, "blink.toml: maximum recursion depth exceeded"),
        (".", {}, "can't read .*: Is a directory"),
        ("blink.c", {}, "blink.c is not an Intel HEX file"),
        ("lost.hex", {}, "can't read .*lost.hex: No such file"),
    ],
)
def test_files_that_are_refused(copy: Any, name: str, changes: dict[str, str], text: str) -> None:
    path = copy(name, "" if name == "lost.hex" else None, **changes)
    with pytest.raises(AppFileError, match=text):
        read_app(path).link(addresses(read_app(path)))


SECTION, SYMBOL = 40, 16
"""Bytes of a section's header, and of a symbol."""


@pytest.mark.parametrize(
    ("place", "value", "text"),
    [
        ("symbol app_main", b"\xff\xff", "defines no function app_main or main"),
        ("symbol app_main", b"\x1e\0", "defines no function app_main or main"),  # in .comment, which is not loaded
        ("target of .rel.rodata", b"\x1d\0\0\0", ".rel.rodata changes .bss, which has no content"),
        ("size of .bss", b"\xff\xff\xff\xff", "its sections up to .bss have 429496.* bytes, more than any module has"),
        ("compressed .text.near", struct.pack("<III", 1, 1 << 30, 4), ".text.near have 1073742110 bytes, more than"),
    ],
)
def test_damaged_headers_of_elf_files(copy: Any, place: str, value: bytes, text: str) -> None:
    path = copy("blink.elf")
    content = bytearray(path.read_bytes())
    for at, data in damage(ELFFile(io.BytesIO(content)), place, value).items():
        content[at : at + len(data)] = data
    path.write_bytes(content)
    with pytest.raises(AppFileError, match=text):
        read_app(path).link(addresses(read_app(path)))


def damage(elf: Any, place: str, value: bytes) -> dict[int, bytes]:
    """Return the bytes to be written, by their places in the file."""
    what, _, name = place.partition(" ")
    headers = {each.name: elf["e_shoff"] + SECTION * index for index, each in enumerate(elf.iter_sections())}
    if what == "symbol":
        table = elf.get_section_by_name(".symtab")
        index = [each.name for each in table.iter_symbols()].index(name)
        return {table["sh_offset"] + SYMBOL * index + 14: value}
    if what == "compressed":
        section = elf.get_section_by_name(name)
        compressed = struct.pack("<I", section["sh_flags"] | 0x800)
        return {headers[name] + 8: compressed, section["sh_offset"]: value}
    return {headers[name.removeprefix("of ")] + {"target": 28, "size": 20}[what]: value}


def test_an_option_replaces_what_the_description_says(copy: Any) -> None:
    app = read_app(copy("blink.elf"), {"name": "other", "stack": 2048, "enabled": True})
    assert (app.name, app.stack, app.setup.flags) == ("other", 2048, 1)


def test_without_the_package_for_elf_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "elftools.elf.elffile", None)
    with pytest.raises(r2p.Error, match=r"ELF files need pyelftools: install r2p\[elf\]"):
        read_app(APPS / "blink.elf")
    assert read_app(APPS / "linked.hex").name == "blink"


def test_a_firmware_of_another_module() -> None:
    app = read_app(APPS / "blink.elf")
    app.check(EMPTY)
    with pytest.raises(LayoutError, match=r"firmware\.elf is not of the firmware of this module: r2p_"):
        app.check(AppinfoSummary(0, 0x08000000, 0x08000000, 0x08020000, 0x20000000, 0x20005000))


def test_a_branch_that_does_not_reach() -> None:
    app = read_app(APPS / "blink.elf")
    far = AppinfoSummary(0, 0x0A00F400, 0x0A00F400, 0x0A020000, 0x20000000, 0x20005000)
    with pytest.raises(LayoutError, match=r"r2p_near\): .* is out of reach of a branch|r2p_publish\): .* out of reach"):
        app.link(addresses(app, far))


@given(st.integers(0, 120), st.binary(max_size=8), st.integers(-4, 12), st.one_of(st.none(), st.integers(0, 2**32 - 1)))
def test_relocations_keep_to_their_place(kind: int, image: bytes, offset: int, symbol: int | None) -> None:
    changed = bytearray(image)
    try:
        relocate(kind, changed, offset, symbol, 0x0800F450)
    except ValueError:
        assert changed == image
    assert len(changed) == len(image)
    assert changed[: max(0, offset)] == image[: max(0, offset)]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(
    st.sampled_from(["blink.elf", "linked.elf", "linked.hex"]),
    st.lists(st.tuples(st.integers(0, 5000), st.binary(min_size=1, max_size=4)), min_size=1, max_size=8),
    st.one_of(st.none(), st.integers(0, 5000)),
)
def test_damaged_files_are_refused_or_linked(
    tmp_path: Path, name: str, damage: list[tuple[int, bytes]], cut: int | None
) -> None:
    content = bytearray((APPS / name).read_bytes())
    for at, data in damage:
        content[at % len(content) : at % len(content) + len(data)] = data
    path = tmp_path / name
    path.write_bytes(bytes(content[:cut]))
    for each in ("blink.toml", "linked.toml", "firmware.elf"):
        shutil.copy(APPS / each, tmp_path)
    try:
        app = read_app(path)
        app.link(addresses(app))
    except LoaderError:
        return
