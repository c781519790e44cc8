"""Transport URLs, their options, and schemes of other packages."""

from importlib import metadata

import pytest

from r2p.errors import TransportError
from r2p.transports import url as urls
from r2p.transports.memory import MemoryTransport
from r2p.transports.url import Url, duration, open_transport, parse, schemes


@pytest.mark.parametrize(
    "text",
    ["serial:/dev/ttyUSB0?baud=9600&x=1", "serial:/dev/ttyUSB0,baud=9600,x=1", "serial:/dev/ttyUSB0?baud=9600,x=1"],
)
def test_options_follow_a_question_mark_or_a_comma(text: str) -> None:
    url = parse(text)
    assert url == Url("serial", "/dev/ttyUSB0", {"baud": "9600", "x": "1"})
    assert parse(str(url)) == url


def test_an_address_keeps_its_colons() -> None:
    assert parse("tcp:[::1]:23") == Url("tcp", "[::1]:23", {})


@pytest.mark.parametrize("text", ["", "tcp", ":host", "tcp:host,baud"])
def test_what_is_no_url(text: str) -> None:
    with pytest.raises(TransportError):
        parse(text)


def test_an_unknown_option_lists_the_known_ones() -> None:
    with pytest.raises(
        TransportError, match="memory: has no option 'los'; it knows: delay, duplicate, jitter, key, loss"
    ):
        open_transport("memory:lab,los=0.1")
    with pytest.raises(TransportError, match="tcp: has no option 'baud'; it knows: key"):
        open_transport("tcp:host:23,baud=9600")


def test_a_bad_value_is_named() -> None:
    with pytest.raises(TransportError, match=r"option loss=2: a probability lies between 0 and 1"):
        open_transport("memory:lab,loss=2")


@pytest.mark.parametrize(
    "url", ["tcp:host", "tcp-listen:", "serial:/dev/ttyUSB0", "memory:lab", "rtcan:can0", "sim:lab"]
)
@pytest.mark.parametrize("value", ["0", "1000001", "many"])
def test_tables_have_a_size_that_makes_sense(url: str, value: str) -> None:
    open_transport(f"{url}?topics=1000000")
    with pytest.raises(TransportError, match=f"topics={value}: give the number of topics that are kept, 1 to 1000000$"):
        open_transport(f"{url}?topics={value}")


def test_an_unknown_scheme_lists_the_known_ones() -> None:
    with pytest.raises(
        TransportError, match=r"unknown transport 'tpc': use one of dds, memory, .*can, serial, sim, tcp"
    ):
        open_transport("tpc:host")


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("can0", "rtcan:can0"),
        ("vcan1", "rtcan:vcan1"),
        ("can:can0", "rtcan:can0"),
        ("tpc:a", "tcp:a"),
        ("10.0.0.5:23", "tcp:10.0.0.5:23"),
        ("robot:2323", "tcp:robot:2323"),
        ("/dev/ttyUSB0", "serial:/dev/ttyUSB0"),
        ("r2psim:lab", "rtcan:r2psim:lab"),
        ("slcan:/dev/ttyACM0", "rtcan:slcan:/dev/ttyACM0"),
    ],
)
def test_what_was_meant(text: str, meant: str) -> None:
    with pytest.raises(TransportError, match=rf"did you mean {meant}\?$"):
        open_transport(text)


def test_a_scheme_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """It names itself in the entry points of the group `r2p.transports`."""
    entry = metadata.EntryPoint("carrier-pigeon", "tests.transports.test_url:pigeon", urls.GROUP)
    broken = metadata.EntryPoint("broken", "no_such_package:transport", urls.GROUP)

    def entry_points(*, group: str, name: str | None = None) -> list[metadata.EntryPoint]:
        return [each for each in (entry, broken) if group == urls.GROUP and name in (None, each.name)]

    monkeypatch.setattr(metadata, "entry_points", entry_points)
    assert open_transport("carrier-pigeon:home") is PIGEON
    assert "carrier-pigeon" in schemes()
    with pytest.raises(TransportError, match="transport 'broken' can't be used here: No module named 'no_such"):
        open_transport("broken:")


PIGEON = MemoryTransport("pigeon")


def pigeon(url: Url) -> MemoryTransport:
    assert url.address == "home"
    return PIGEON


@pytest.mark.parametrize(
    ("text", "seconds"), [("10ms", 0.01), ("20us", 2e-5), ("5ns", 5e-9), ("1.5s", 1.5), ("2", 2.0), ("1e-3", 1e-3)]
)
def test_durations(text: str, seconds: float) -> None:
    assert duration(text) == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["", "ms", "1 hour", "-1ms", "1e999", "e", "1.2.3s"])
def test_what_is_no_duration(text: str) -> None:
    with pytest.raises(ValueError, match=r"duration|float"):
        duration(text)
