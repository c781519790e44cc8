"""What zenoh-ros2-sdk sends and accepts, and what pamoja-ros2 thinks of it (tests/golden/ros; `about` says how)."""

import functools
import json
from pathlib import Path
from typing import Any

from r2p.ros.middleware import Qos
from r2p.ros.type_names import dds_type

SESSION = "c0ffee"
"""The session in the place of those that the recording leaves out."""
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
SET_BOOL_HASH = "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a"

_INFINITE = [9_223_372_036, 854_775_807]


@functools.cache
def recorded() -> dict[str, Any]:
    text = (Path(__file__).parents[2] / "golden" / "ros" / "rmw_zenoh.json").read_text()
    found: dict[str, Any] = json.loads(text.replace("<SDK_ZID>", SESSION).replace("<PEER_ZID>", SESSION))
    return found


def qos_of(recorded_qos: dict[str, Any] | None) -> Qos:
    """The QoS of a recorded one, whose liveliness r2p does not use."""
    if recorded_qos is None:
        return Qos()
    return Qos(
        recorded_qos["reliability"] == "RELIABLE",
        recorded_qos["durability"] == "TRANSIENT_LOCAL",
        0 if recorded_qos["history"] == "KEEP_ALL" else recorded_qos["depth"],
        _time(recorded_qos["deadline"]),
        _time(recorded_qos["lifespan"]),
    )


def _time(parts: list[int]) -> int:
    """Ns; 0 for a time without a limit, which any number of seconds as large as that is."""
    return 0 if parts[0] >= _INFINITE[0] else parts[0] * 1_000_000_000 + parts[1]


def has_own_liveliness(recorded_qos: dict[str, Any]) -> bool:
    return bool(recorded_qos["liveliness"] != "AUTOMATIC" or recorded_qos["lease"] != _INFINITE)


def type_of(case: dict[str, Any]) -> str:
    """The type as in keys."""
    return dds_type(case["type"], service=case["kind"].startswith("service"))
