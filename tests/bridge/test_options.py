"""What the options of a gateway let through."""

from __future__ import annotations

import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.bridge.options import Policy, is_link, parse_rule


@pytest.mark.parametrize("text", ["", "@", "leds@", "leds@a>", "@a"])
def test_rules_without_sense(text: str) -> None:
    with pytest.raises(r2p.Error, match="write TOPIC, TOPIC@FROM"):
        parse_rule(text)


def test_links_are_meant_by_name_kind_or_pattern() -> None:
    assert all(is_link("tcp:10.0.0.5:23", each) for each in ("tcp", "tcp:10.0.0.5:23", "tcp:10.*", "*"))
    assert not any(is_link("tcp:10.0.0.5:23", each) for each in ("tcp-listen", "tcp:", "zenoh", ""))


def test_loader_topics_come_in_from_ip_links_only_with_permission() -> None:
    strict, open_ = Policy(BridgeOptions()), Policy(BridgeOptions(allow_control=True))
    for link in ("tcp:10.0.0.5:23", "zenoh:"):
        assert not strict.allows("BOOT_IMU1", link, "rtcan:can0")
        assert strict.allows("BOOT_IMU1", "rtcan:can0", link)
        assert open_.allows("BOOT_IMU1", link, "rtcan:can0")
        assert not strict.order_denied(link, "rtcan:can0", harmless=True)
        assert strict.order_denied(link, "rtcan:can0", harmless=False)
    assert strict.allows("BOOT_IMU1", "serial:/dev/ttyUSB0", "rtcan:can0")


def test_links_of_one_kind_are_treated_alike() -> None:
    policy = Policy(BridgeOptions(deny=("*@tcp-listen*>tcp-listen*",), allow=("cmd_*@zenoh>rtcan", "log")))
    clients = [f"tcp-listen:0#{number}" for number in range(3)]
    assert len({policy.kind(each) for each in clients}) == 1
    assert len({policy.kind(each) for each in (clients[0], "zenoh:", "rtcan:can0", "serial:/dev/ttyUSB0")}) == 4
