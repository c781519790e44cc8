"""The emulated loader against what was recorded from the firmware's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from r2p.codecs import debug
from r2p.sim.modules import EmulatedLoader, FirmwareModule, MemoryMap
from tests.sim.modules.test_firmware import Line, recorded
from tests.vectors import TO_NODE, Case, cases, loader_cases

if TYPE_CHECKING:
    from collections.abc import Iterator

MS = 1_000_000
STARTED = 10  # ms; in one recording the module's second ALIVE was not yet out when REBOOT came, 495 ms after the first
LATE = 30  # ms; the recorded loader was up to 110 ms later, when its computer had other work

SESSIONS = loader_cases() + cases("bootloader")


def recorded_module(case: Case) -> FirmwareModule:
    """Two builds were recorded, which differ in how they align RAM."""
    memory = MemoryMap(ram_align=8 if case in loader_cases() else 16)
    return FirmwareModule("IMU1", repeats="noiter" not in case.build, loader=EmulatedLoader(memory))


def said(case: Case) -> Iterator[tuple[int, bytes]]:
    """What the peer sent, with the right checksum of each line: firmware does not check it."""
    for entry in case.transcript:
        if entry.dir == TO_NODE:
            _, topic, data, _ = entry.data.split(b":")
            yield entry.t_ms, debug.encode(topic[2:], bytes.fromhex(data[2:].decode()), 0)


def replay(case: Case, size: int = 1000) -> Line:
    """The emulated module in the recorded one's place; it gets what the peer sent in chunks of `size` bytes."""
    started = case.transcript[0].t_ms + STARTED
    line = Line(recorded_module(case), started * MS, boot_mode=case.env.get("R2P_BOOTMODE") == "1")
    for at, data in said(case):
        line.until(at)
        for start in range(0, len(data), size):
            line.send(data[start : start + size])
    line.until(case.transcript[-1].t_ms + STARTED + 5)
    return line


@pytest.mark.golden
@pytest.mark.parametrize("case", SESSIONS, ids=str)
def test_it_answers_what_firmware_answered(case: Case) -> None:
    """The same bytes in the same order, and not later."""
    ours, theirs = replay(case).heard, list(recorded(case))
    assert [what for _, what in ours] == [what for _, what in theirs]
    assert max(a - b for (a, _), (b, _) in zip(ours, theirs, strict=True)) <= LATE


@pytest.mark.golden
@pytest.mark.parametrize("size", range(1, 90))
def test_it_answers_the_same_to_chunks_of_every_size(size: int) -> None:
    case = SESSIONS[size % len(SESSIONS)]
    assert [what for _, what in replay(case, size).heard] == [what for _, what in recorded(case)]


@pytest.mark.golden
@pytest.mark.parametrize("case", [case for case in SESSIONS if case.name == "load_reboot_launch"], ids=str)
def test_it_starts_the_apps_that_firmware_started(case: Case) -> None:
    assert list(replay(case).module.log) == ["LAUNCH APP1"]
