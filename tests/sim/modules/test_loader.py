"""The emulated loader against what was recorded from the firmware's."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.codecs import debug, loader, management
from r2p.codecs.loader import (
    Ack,
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
    Nack,
    ParamChunk,
    ParamRequest,
    RemoveAll,
    RemoveLast,
)
from r2p.msg import Led
from r2p.sim.modules import BOARD, EmulatedLoader, FirmwareModule, FlashTimes, MemoryMap, Publishes
from r2p.sim.modules.flash import SIMULATED
from tests.sim.modules.loader_rig import LinePeer, acknowledged, load, record
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


# What was not recorded


SMALL_PAGES = MemoryMap(page=256)


def module(memory: MemoryMap | None = None, times: FlashTimes = SIMULATED) -> FirmwareModule:
    return FirmwareModule("IMU1", repeats=False, loader=EmulatedLoader(memory, times=times))


def test_ram_is_handed_out_anew_after_a_restart() -> None:
    """The trap of the original: the second app gets the RAM of the first, and the module starts both."""
    peer = LinePeer(module())
    peer.run(load("ONE"))
    peer.power_on()
    peer.run(load("TWO"))
    one, two = peer.module.loader.apps
    assert one.bssadr == two.bssadr
    peer.power_on(boot_mode=False)
    peer.wait(1000)
    assert list(peer.module.log) == ["LAUNCH ONE", "LAUNCH TWO", "TWO shares RAM with ONE"]


def test_a_stack_that_is_too_small_halts_the_module_at_each_start() -> None:
    peer = LinePeer(module())
    peer.run(load(stack=100))
    for _ in range(2):
        peer.power_on(boot_mode=False)
        peer.wait(2000)
        assert "app APP1: a stack of 100 bytes is too small" in peer.module.fault
        assert peer.module.halted
    peer.power_on()
    assert peer.apps() == ["APP1"]


def test_an_app_does_what_its_program_says() -> None:
    """With its parameters, and only while it is enabled."""

    def blink(config: bytes) -> list[Publishes]:
        return [Publishes("leds", Led, period=0.1, fill=lambda _time: Led(led=config[0]))]

    peer = LinePeer(module())
    peer.module.programs["APP1"] = blink
    peer.run(load())
    peer.power_on(boot_mode=False)
    peer.wait(600)
    peer.hear(peer.module.receive(peer.now, subscribe_request("leds", 5)))
    peer.wait(1000)
    assert peer.module.sent["leds"] == 10
    peer.power_on()
    peer.wait(1000)
    assert peer.module.sent["leds"] == 10


def subscribe_request(topic: str, size: int) -> bytes:
    return debug.encode(b"R2P", management.encode(management.SubscribeRequest(topic, size, 5)), 0)


def test_erasing_and_writing_take_time_on_a_board_which_is_deaf_meanwhile() -> None:
    """REMOVE_ALL: an erasure and a write for each page that is in use, and nothing for the others."""
    peer = LinePeer(module(SMALL_PAGES, BOARD))
    peer.run(load(text=bytes(1000)), ms=200)
    assert peer.ask(BeginLoader()) == [Ack()]
    assert peer.ask(RemoveAll(), ms=5 * 56) == []
    assert peer.ask(BeginLoader(), ms=20) == [Ack()]  # the one to REMOVE_ALL
    assert peer.module.drops["writing flash"] == 1
    assert peer.module.loader.flash.erasures == 5
    assert peer.module.loader.flash.data.count(0xFF) == len(peer.module.loader.flash.data)


@pytest.mark.parametrize("late", [0, 10, 25, 40, 70])
def test_a_power_cut_at_any_step_of_a_load_leaves_the_app_or_not(late: int) -> None:
    """`late` ms after each message: before it is handled, and while a page is written."""
    for step in itertools.count():
        peer = LinePeer(module(SMALL_PAGES, BOARD))
        peer.run(load("OLD", text=bytes(80)), ms=100)
        session = load("NEW", text=bytes(64))  # on two pages: that of OLD, and the next
        message = next(session)
        for _ in range(step):
            message = session.send(peer.ask(message, 100)[-1])
        peer.send(message)
        peer.wait(late)
        peer.power_on()
        found = peer.apps()
        if isinstance(message, EndLoader):  # at 25 ms its entry is half written
            assert found == {0: ["OLD"], 10: ["OLD"], 25: ["OLD", "????????"]}.get(late, ["OLD", "NEW"])
            peer.run(acknowledged(BeginLoader(), RemoveAll(), EndLoader()), ms=4000)
            return
        assert found == ["OLD"]
        peer.run(load("NEW", text=bytes(64)), 100)
        assert peer.apps() == ["OLD", "NEW"]


@pytest.mark.parametrize(("late", "found"), [(0, ["APP1"]), (20, []), (45, ["APP1"]), (70, ["APP1"])])
def test_a_power_cut_while_a_parameter_is_saved_may_cost_the_app(late: int, found: list[str]) -> None:
    """Its page is erased: what was on it is gone until it is written again, from its beginning."""
    peer = LinePeer(module(times=BOARD))
    peer.run(load(), ms=100)
    peer.run(acknowledged(BeginSetparam(), ParamRequest(0, "APP1", 2), ParamChunk(bytes(16))))
    peer.send(EndSetparam())
    peer.wait(late)
    peer.power_on()
    assert peer.apps() == found


def test_a_power_cut_while_the_first_of_two_messages_is_written_leaves_it_half_done() -> None:
    """The second one waits in the queue until then."""
    peer = LinePeer(module(SMALL_PAGES, BOARD))
    peer.run(load(text=bytes(64)), ms=100)
    for message in (BeginLoader(), RemoveLast()):
        assert peer.ask(message) == [Ack()]
    peer.send(EndLoader())
    peer.send(BeginLoader())
    peer.wait(20)
    peer.power_on()
    start = bytes(peer.module.loader.flash.data[:4])
    assert start == b"\xff" * 4, "neither the app's signature nor the one that marks it as removed"


def test_worn_flash_halts_the_module_when_the_page_is_written() -> None:
    peer = LinePeer(module())
    peer.module.loader.flash.worn[0x0800F450] = 0b1000_0001
    with pytest.raises(AssertionError, match="no answer to EndLoader"):
        peer.run(load(text=b"\xff" * 40))
    assert peer.module.halted
    assert "flash" in peer.module.fault


def test_faults_are_injected_by_number() -> None:
    peer = LinePeer(module())
    faults = peer.module.loader.faults
    faults.lost_requests, faults.lost_answers, faults.refused = {1}, {2}, {5}
    assert peer.ask(BeginLoader()) == []
    assert peer.ask(BeginLoader()) == [Ack()]
    assert peer.ask(EndLoader()) == []  # it is idle now
    assert peer.ask(BeginLoader()) == [Ack()]
    assert peer.ask(RemoveAll()) == [Nack(0)]
    assert peer.ask(RemoveAll()) == [Nack(45)]
    assert peer.module.loader.drops == {"lost request": 1, "lost answer": 1}


def test_a_half_word_of_a_board_takes_its_other_byte_from_the_flash() -> None:
    """Two records that share a word: the first one's half of it is lost."""
    peer = LinePeer(module(MemoryMap(word=2)))
    session = load(text=bytes([1] * 33))
    message = next(session)
    while not (isinstance(message, IhexRecord) and message.kind == 0):
        message = session.send(peer.ask(message)[-1])
    for piece in (record(0, 0xF450, b"\x01" * 3), record(0, 0xF453, b"\x02" * 3), record(1), EndLoader()):
        assert Ack() in peer.ask(piece)
    assert peer.module.loader.flash.read(0x0800F450, 7).hex() == "0101ff020202ff"


def test_lengths_that_wrap_make_the_list_of_apps_endless() -> None:
    peer = LinePeer(module())
    session = load()
    assert peer.ask(next(session)) == [Ack()]
    # The next app would be where this one is.
    (addresses,) = peer.ask(LinkingSetup(0xFFFFFFB0, 0, 0, 512, "LOOP", 1))
    assert isinstance(addresses, LinkingAddresses)
    assert addresses.nextadr == addresses.infoadr
    for message in (LinkingOutcome(0, 0, 0, 0, 0, 0, 0), record(1), EndLoader()):
        assert Ack() in peer.ask(message)
    assert peer.ask(BeginAppinfo()) == []
    assert "leads back" in peer.module.fault
    peer.power_on(boot_mode=False)
    peer.wait(1000)
    assert peer.module.halted


# Hostile input

numbers = st.integers(0, 2**32 - 1) | st.sampled_from([0, 16, 0x0800F400, 0x0800F450, 0x20005000])
texts = st.sampled_from(["", "APP1", "B", "ABCDEFGH"])
bytes16 = st.binary(min_size=16, max_size=16)
records = st.builds(record, st.integers(0, 6), st.sampled_from([0, 0xF450, 0xF460]), st.binary(max_size=16))
messages = st.one_of(
    st.sampled_from([each() for each in (BeginLoader, EndLoader, RemoveLast, RemoveAll, BeginAppinfo, EndAppinfo)]),
    st.sampled_from([each() for each in (BeginSetparam, EndSetparam, BeginGetparam, EndGetparam, Ack, Nack)]),
    st.builds(LinkingSetup, numbers, numbers, numbers, numbers, texts, st.integers(0, 3)),
    st.builds(LinkingOutcome, *[numbers] * 7),
    records,
    st.builds(ParamRequest, numbers, texts, st.integers(0, 255)),
    st.builds(ParamChunk, bytes16),
)
packed = messages.map(loader.encode) | st.binary(min_size=31, max_size=31)


@settings(max_examples=150, deadline=None)
@given(st.lists(packed, max_size=40), st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), max_size=5))
def test_it_survives_anything(received: list[bytes], damage: list[tuple[int, int]]) -> None:
    """It never raises, whatever comes and whatever its flash holds; then it is idle soon, or says why it has failed."""
    peer = LinePeer(module(MemoryMap(word=2)))
    peer.run(load(data=b"data"))
    for at, value in damage:
        peer.module.loader.flash.data[at] = value
    for data in received:
        peer.hear(peer.module.receive(peer.now, debug.encode(b"BOOT_IMU1", data, 0)))
        peer.wait(10)
    if not peer.module.fault:
        peer.ask(BeginLoader())
        answers = peer.ask(BeginLoader())
        assert bool(peer.module.fault) or answers in ([Ack()], [Nack(131)])
    peer.power_on(boot_mode=False)
    peer.wait(1000)
