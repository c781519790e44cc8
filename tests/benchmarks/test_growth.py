"""How the cost grows, in operations that are counted instead of time; and the picture for the documentation."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest

from benchmarks.growth import draw, router_mesh, zenoh_network
from benchmarks.growth.curve import Curve, exponent
from benchmarks.growth.router_mesh import Sent
from r2p.codecs import liveliness, management
from r2p.protocols.discovery.events import QueryTokens
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.liveliness.session import LivelinessDiscovery

RESULTS = Path(draw.__file__).parents[2] / "docs" / "assets" / "performance" / "growth.json"


def calls(function: Callable[[], object]) -> int:
    """Return how many functions in Python are called."""
    count = 0

    def profile(frame: FrameType, event: str, argument: object) -> None:
        nonlocal count
        count += event == "call"

    sys.setprofile(profile)
    try:
        function()
    finally:
        sys.setprofile(None)
    return count


def test_the_exponent_is_the_slope_of_the_logarithms() -> None:
    assert exponent([(n, 3 * n**1.5) for n in (1, 10, 100)]) == pytest.approx(1.5)
    assert exponent([(10, 5.0), (100, 5.0)]) == pytest.approx(0.0)
    assert exponent([(10, 5.0), (10, 6.0)]) is None
    assert exponent([(10, 0.0), (100, 5.0)]) is None


def test_a_module_that_joins_a_network_works_in_proportion_to_its_size() -> None:
    points = []
    for modules in (5, 15, 40):
        keys = [liveliness.token_of(key.removeprefix("live/")) for key in zenoh_network.keys(modules)]
        joins = LivelinessDiscovery("JOINS", 0xFFFF)
        joins.link_up(0)
        liveliness.tokens_of.cache_clear()

        def join(joins: LivelinessDiscovery = joins, keys: list[str] = keys) -> None:
            for key in keys:
                joins.appeared(0, key)

        points.append((modules, calls(join)))
        assert len(joins.topics) == modules * 10
    power = exponent(points)
    assert power is not None
    assert 0.95 < power < 1.05


def test_keys_grow_with_modules_and_one_change_is_one_key() -> None:
    assert exponent([(n, len(zenoh_network.keys(n))) for n in (3, 30)]) == pytest.approx(1.0)
    assert len(zenoh_network.keys(3)) == 6


def test_what_is_repeated_costs_the_same_whatever_the_number_of_modules() -> None:
    points = []
    for modules in (10, 40, 160):
        hears = Discovery("HEARS", 0xFFFF)
        hears.link_up(0)
        repeated = [
            [management.encode(each) for each in said]
            for said in zip(*(announcements(number) for number in range(modules)), strict=True)
        ]

        def hear(hears: Discovery = hears, repeated: list[list[bytes]] = repeated) -> None:
            for said in repeated:
                for number, data in enumerate(said):
                    hears.receive(1, data, number)

        hear()
        points.append((modules, calls(hear)))
        assert len(hears.modules) == len(hears.topics) == modules
        assert calls(functools.partial(hears.receive, 2, repeated[1][0], 0)) < 20
    power = exponent(points)
    assert power is not None
    assert power < 1.02


def announcements(number: int) -> tuple[management.Management, ...]:
    name = f"M{number}"
    hello = management.Hello(name, number + 1, lease_ms=60_000, wire=management.WIRE_VERSION)
    return hello, management.Alive(name, 0), management.Advertise(f"t{number}", 8)


def test_time_at_rest_is_nothing() -> None:
    """Nothing is due in a network where nothing changes, however large it is, once all tokens have been queried."""
    joins = LivelinessDiscovery("JOINS", 0xFFFF)
    joins.link_up(0)
    joins.poll(0)
    for key in zenoh_network.keys(20):
        joins.appeared(0, liveliness.token_of(key.removeprefix("live/")))
    assert len(joins.topics) == 200
    queried = joins.next_deadline()
    assert queried is not None
    assert QueryTokens() in joins.poll(queried)
    joins.query_ended(queried, complete=True)
    assert joins.next_deadline() is None


def test_until_each_message_comes_once() -> None:
    def sent(*numbers: int) -> list[Sent]:
        return [Sent(number=number, at=number * 10_000_000) for number in numbers]

    assert router_mesh.until_each_once(sent(1, 2, 3, 4)) == 0.0
    assert router_mesh.until_each_once(sent(1, 2, 12, 13)) == pytest.approx(0.11)
    assert router_mesh.until_each_once(sent(1, 2, 12, 12, 13, 14)) == pytest.approx(0.11)
    assert router_mesh.until_each_once(sent(1, 5, 6, 8, 9)) == pytest.approx(0.07)


def test_the_picture_is_what_the_results_on_the_page_give(tmp_path: Path) -> None:
    draw.draw(draw.read(RESULTS)).write(tmp_path / "growth.svg")
    assert (tmp_path / "growth.svg").read_text() == RESULTS.with_suffix(".svg").read_text()


def test_a_curve_without_a_goal_or_a_value_is_not_drawn(tmp_path: Path) -> None:
    curves = [
        Curve("drawn", "modules", "s", [(10, 1.0), (100, 10.0)], goal=20.0),
        Curve("without a goal", "modules", "s", [(10, 1.0)]),
        Curve("nothing lost", "modules", "%", [(10, 0.0)], goal=0.0),
    ]
    draw.draw(curves).write(tmp_path / "growth.svg")
    text = (tmp_path / "growth.svg").read_text()
    assert "drawn, N^1.00" in text
    assert "without a goal" not in text
    assert "nothing lost" not in text
