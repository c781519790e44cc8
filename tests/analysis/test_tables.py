"""Message sets as CSV, TOML and DBC."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from r2p.analysis import BusMessage, MessageClass
from r2p.analysis.dbc import read_dbc, write_dbc
from r2p.analysis.tables import MessageSet, read_csv, read_toml, write_csv
from r2p.errors import Error, MessageError
from r2p.units import MILLISECOND

SETS = sorted((Path(__file__).parents[1] / "golden" / "sets").glob("*.csv"))
PLAIN = BusMessage(name="tilt", id=0x20, size=8, period=10 * MILLISECOND, deadline=5 * MILLISECOND, node="IMU")
RTCAN = [
    BusMessage(name=name, id=number, size=size, period=period, deadline=deadline, message_class=kind, node="A")
    for name, number, size, period, deadline, kind in (
        ("odometry", 0x0201, 18, 2_500_000, 2_500_000, MessageClass.HRT),
        ("bumper", 0x0301, 8, 20_000_000, 5_500_000, MessageClass.SRT),
        ("log", 0x0401, 300, None, None, MessageClass.NRT),
    )
]


def test_toml_has_the_bus_and_texts_with_units() -> None:
    found = read_toml(
        '[bus]\nbitrate = 500_000\nslots = 20\ncycle = "20ms"\n'
        '[[message]]\nname = "tilt"\nid = 0x20\nnode = "IMU"\nbytes = 8\nperiod = "10ms"\ndeadline = "5ms"\n'
        '[[message]]\nname = "wide"\nid = 0x800\nbytes = 0\nperiod = 1\njitter = "20us"\n'
    )
    wide = BusMessage(name="wide", id=0x800, extended=True, size=0, period=10**9, deadline=10**9, jitter=20_000)
    assert found == MessageSet([PLAIN, wide], 500_000, 20, 20 * MILLISECOND)


def test_messages_without_identifiers_have_the_priority_of_their_order() -> None:
    found = read_csv("# a comment\nname,bytes,period_ms,extra\na,1,10,x\nb,2,5,y\n").messages
    assert [(each.name, each.id, each.deadline) for each in found] == [("a", 1, 10**7), ("b", 2, 5 * 10**6)]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "begins with the names of its columns"),
        ("id,bytes\n1,2\n", "begins with the names of its columns"),
        ("name,bytes\na,9\n", "a: 9 bytes: a frame has up to 8"),
        ("name,bytes,class\na,1025,srt\n", "a: 1025 bytes: a message has up to 1024"),
        ("name,bytes,class\na,8,fast\n", "a: the class 'fast' is none of can, hrt, srt, nrt"),
        ("name,bytes,period_ms\na,8,x\n", "a: period is 'xms': write a time"),
        ("name,bytes,period_ms\na,8,0\n", "a: a period of 0 s"),
        ("name,bytes,id\na,8,x\n", "a: id is 'x': write a whole number"),
        ("name,bytes,id\na,8,0x20000000\n", "a: the identifier 0x20000000 has more than 29 bits"),
        ("name,bytes,id\na,8,1\nb,8,\n", "b has no id"),
        ("name,bytes,jitter_ms\na,8,-1\n", "jitter is '-1ms'"),
    ],
)
def test_what_no_bus_can_carry_is_an_error_that_says_why(text: str, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        read_csv(text)


@pytest.mark.parametrize("text", ["x", "[bus]\nslots = 3\n", "message = 3\n", "message = [1]\n", "[[message]]\nid=1"])
def test_what_is_no_toml_of_messages_is_an_error(text: str) -> None:
    with pytest.raises(MessageError):
        read_toml(text)


def plain_nodes(messages: list[BusMessage]) -> list[BusMessage]:
    """Names of nodes become those of C, and Vector__XXX is none."""
    names = {each.node: each.node.replace("/", "_").removeprefix("Vector__XXX") for each in messages}
    return [msgspec.structs.replace(each, node=names[each.node]) for each in messages]


@pytest.mark.parametrize("path", SETS, ids=lambda each: each.stem)
def test_real_sets_survive_csv_and_cantools(path: Path) -> None:
    messages = read_csv(path.read_text(encoding="utf-8")).messages
    assert read_csv(write_csv(messages)).messages == messages
    found = read_dbc(write_dbc(messages, 500_000))
    assert found.messages == plain_nodes(messages)
    assert found.bitrate == 500_000


def test_cantools_has_identifiers_lengths_senders_and_cycle_times() -> None:
    from cantools.database import load_string

    database: Any = load_string(write_dbc([PLAIN, *RTCAN]), "dbc")
    tilt = database.get_message_by_name("tilt")
    assert (tilt.frame_id, tilt.is_extended_frame, tilt.length) == (0x20, False, 8)
    assert (tilt.senders, tilt.cycle_time) == (["IMU"], 10)
    odometry = database.get_message_by_name("odometry")
    assert (odometry.frame_id, odometry.is_extended_frame, odometry.length) == (0x0201 << 7 | 2, True, 8)
    assert odometry.cycle_time is None  # it is no whole number of ms
    bumper = database.get_message_by_name("bumper")
    assert bumper.frame_id == 5 << 23 | 0x0301 << 7


def test_messages_of_rtcan_survive_as_well() -> None:
    assert read_dbc(write_dbc(RTCAN)).messages == RTCAN
    assert read_csv(write_csv(RTCAN)).messages == RTCAN


def test_names_become_those_of_c_and_come_back() -> None:
    names = ["arm/left/joint_position_with_a_long_name", "arm/left/joint_position_with_a_long_name2", "1st", "a b"]
    messages = [msgspec.structs.replace(PLAIN, name=name, id=number) for number, name in enumerate(names)]
    assert [each.name for each in read_dbc(write_dbc(messages)).messages] == names


def test_a_dbc_that_is_none_or_of_can_fd_is_an_error() -> None:
    with pytest.raises(MessageError, match="not a DBC file"):
        read_dbc("BO_ nonsense")
    wide = write_dbc([PLAIN]).replace("tilt: 8", "tilt: 64")
    with pytest.raises(MessageError, match="tilt and 0 others are frames of CAN FD"):
        read_dbc(wide)
    with pytest.raises(MessageError, match="tilt and tilt have the same identifier"):
        write_dbc([PLAIN, PLAIN])


def test_without_cantools_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cantools.database", None)
    with pytest.raises(Error, match=r"r2p\[dbc\]"):
        read_dbc(write_dbc([PLAIN]))
