"""What happened in a recording, as lines in the order of time."""

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import r2p
from r2p.messages import Message
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.entries import BagEntry, EntryWriter, MessageEntry, SampleEntry
from r2p.recording.messages import (
    EVENTS,
    LOGS,
    PARAMETERS,
    SIGNALS,
    SLOTS,
    STATISTICS,
    LogRecord,
    ParameterValue,
    RecordedEvent,
    RecordedSignal,
    SlotOwner,
    SlotTable,
)
from r2p.recording.timeline import KINDS, collapsed, slots_at, timeline
from r2p.recording.writer import BagWriter
from r2p.tools.bag import events
from r2p.units import SECOND

START = 1_700_000_000 * SECOND  # 22:13:20 UTC
MS = SECOND // 1000

Write = Callable[[Path], Path]


def at(seconds: float, channel: str, message: Message) -> MessageEntry:
    return MessageEntry(channel, message, START + round(seconds * SECOND))


def missed(seconds: float, sequence: int, late: float = 0.0) -> MessageEntry:
    """A miss of a publisher of the recording module."""
    reason, where = "no room by the deadline", "tcp"
    return at(seconds, SIGNALS, signal("missed", reason, where, late=late, count=1, sequence=sequence))


def signal(kind: str, reason: str, where: str, **numbers: float) -> RecordedSignal:
    return RecordedSignal(kind, "publisher", "steer", "ROBOT", "control", 2, reason, where, **numbers)  # type: ignore[arg-type]


def log(seconds: float, level: int, text: str) -> MessageEntry:
    return at(seconds, LOGS, LogRecord(level=level, name="ARM/reach", msg=text))


def led(seconds: float, late: float, sequence: int) -> SampleEntry:
    """A message that was due before it came."""
    now = START + round(seconds * SECOND)
    due = now - round(late * SECOND)
    source = r2p.Source("ARM", "blink", "tcp")
    sample = r2p.Sample(Led().encode(), source, due - 10 * MS, due, sequence, r2p.PublisherClass.SPORADIC)
    return SampleEntry("leds", sample, Led, now)


def table(seconds: float, master: str, **slots: tuple[str, tuple[int, ...]]) -> MessageEntry:
    owners = tuple(SlotOwner(topic, module, numbers) for topic, (module, numbers) in slots.items())
    return at(seconds, SLOTS, SlotTable("rtcan:can0", 0.01, 60, master, (SlotOwner("sync", master, (0,)), *owners)))


def counted(seconds: float, count: int, topic: str = "grip") -> MessageEntry:
    fields = {"interval": 1.0, "count": count}
    return at(seconds, SIGNALS, RecordedSignal("missed", "statistics", topic, "ARM", "reach", **fields))  # type: ignore[arg-type]


ENTRIES: list[BagEntry] = [
    at(0, EVENTS, RecordedEvent(kind="link up", link="tcp", text="as the recording began")),
    at(0, PARAMETERS, ParameterValue("ROBOT", "control", "kp", "float", "0.5", 0.5, "1/s", "code")),
    table(1, "BOSS", encoder=("BOSS", (3, 33)), pose=("ARM", (7,))),
    table(11, "BOSS", encoder=("BOSS", (3, 33)), pose=("ARM", (7,))),
    *(missed(12 + number / 100, number) for number in range(1, 5)),
    at(12.5, SIGNALS, signal("degraded", "link down", "tcp")),
    missed(13.5, 9, late=0.004),
    log(14.0, logging.WARNING, "topic grip (tcp:): no room by the deadline by 1.5 ms (missed 2, late 0 so far)"),
    log(14.0, logging.WARNING, "the motor is hot"),
    log(14.1, logging.INFO, "all is well"),
    at(14.5, f"{STATISTICS}/ARM", r2p.ModuleStatistics()),
    counted(14.5, 2),
    counted(14.6, 3, "other"),
    led(15.0, -0.001, 7),
    led(15.1, 0.0032, 8),
    log(15.9, logging.WARNING, "topic grip (tcp:): no room by the deadline by 1.5 ms (missed 6, late 0 so far)"),
    at(16, EVENTS, RecordedEvent(kind="no master", link="rtcan:can0", text="no RTCAN master: no sync for too long")),
    at(16.1, EVENTS, RecordedEvent(kind="master", link="rtcan:can0", module="ARM", text="ARM is the RTCAN master")),
    table(16.5, "ARM", encoder=("BOSS", (4,)), new=("ARM", (9,))),
    at(17, PARAMETERS, ParameterValue("ROBOT", "control", "kp", "float", "0.75", 0.75, "1/s", "run time")),
    at(18, EVENTS, RecordedEvent(kind="link down", link="tcp", text="connection lost")),
    at(19, EVENTS, RecordedEvent(kind="link up", link="tcp", outage=1.0, count=3)),
    at(20, EVENTS, RecordedEvent(kind="module silent", module="BOSS")),
    at(21, EVENTS, RecordedEvent(kind="something new", text="of a later version")),
]

LINES = """
22:13:20.000 link      tcp: up: as the recording began
22:13:32.010 missed    steer of ROBOT/control: no room by the deadline (tcp), 4 until 22:13:32.040
22:13:32.500 degraded  steer of ROBOT/control: link down (tcp)
22:13:33.500 missed    steer of ROBOT/control: no room by the deadline (tcp), 4.0 ms late, message 9
22:13:34.000 log       ARM/reach: WARNING: the motor is hot
22:13:34.500 missed    grip of ARM/reach: no room by the deadline, as it logged, 2 messages
22:13:34.600 missed    other of ARM/reach: as it counted, 3 messages
22:13:35.100 overdue   leds of ARM/blink: received after its deadline, 3.2 ms late, message 8
22:13:35.900 missed    grip of ARM/reach: no room by the deadline, as it logged
22:13:36.000 master    rtcan:can0: no RTCAN master: no sync for too long
22:13:36.100 master    rtcan:can0: ARM is the RTCAN master
22:13:36.500 slots     encoder of BOSS: has slot 4 instead of slots 3, 33 on rtcan:can0
22:13:36.500 slots     new of ARM: has slot 9 on rtcan:can0
22:13:36.500 slots     pose of ARM: has lost slot 7 on rtcan:can0
22:13:37.000 parameter ROBOT/control.kp: 0.75 1/s, was 0.5 (run time)
22:13:38.000 link      tcp: down: connection lost
22:13:39.000 link      tcp: up after 1 s, 3 messages lost
22:13:40.000 module    BOSS: silent
22:13:41.000 notice    something new: of a later version
""".strip().splitlines()


@pytest.fixture(autouse=True)
def utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "UTC")
        time.tzset()
        yield
    time.tzset()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return bag_of(tmp_path / "drive.mcap", ENTRIES)


def bag_of(path: Path, entries: list[BagEntry]) -> Path:
    with path.open("xb") as file:
        writer = BagWriter(file)
        out = EntryWriter(writer)
        for entry in entries:
            out.write(entry)
        writer.finish()
    return path


def test_everything_comes_in_order(path: Path) -> None:
    with Bag(path) as bag:
        assert [events._line(each) for each in collapsed(timeline(bag))] == LINES


def test_a_window_has_the_same_lines_as_all_of_it(path: Path) -> None:
    """Changes are found against what was before the window."""
    with Bag(path) as bag:
        found = [events._line(each) for each in timeline(bag, START + 16 * SECOND, START + 18 * SECOND)]
    assert found == LINES[9:15]


def test_each_miss_is_there_by_itself(path: Path) -> None:
    with Bag(path) as bag:
        found = [each for each in timeline(bag) if each.kind == "missed"]
    counts = [(each.count, each.sequence) for each in found]
    assert counts == [
        *((1, n) for n in range(1, 5)),
        (1, 9),
        (2, 0),
        (3, 0),
        (1, 0),
    ]


def test_who_owned_which_slot(path: Path) -> None:
    with Bag(path) as bag:
        before, after = slots_at(bag, START + 14 * SECOND), slots_at(bag, bag.end)
        assert slots_at(bag, START) == []
    assert [(owner.topic, owner.slots) for owner in before[0].owners] == [
        ("sync", (0,)),
        ("encoder", (3, 33)),
        ("pose", (7,)),
    ]
    assert (before[0].master, after[0].master) == ("BOSS", "ARM")


def test_the_command_knows_all_kinds() -> None:
    assert tuple(KINDS) == events._KINDS
