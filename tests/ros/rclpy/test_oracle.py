"""Every type in the packages that come with rclpy: its hash, and bytes which rclpy reads and writes."""

from __future__ import annotations

import functools
import json
import random
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.messages import Array, FixedArray, Nested, Scalar, Shape, VariableArray, VariableText
from r2p.ros.cdr import cdr
from r2p.ros.classes import RosTypes
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.library import DefinitionFile
from tests.ros.rclpy import install
from tests.ros.test_recorded_messages import REFUSED

if TYPE_CHECKING:
    from pathlib import Path

    from tests.ros.rclpy.peer import RclpyPeer

pytestmark = [pytest.mark.xdist_group("rclpy"), pytest.mark.processes]

EXAMPLES = 5
"""Messages of each type."""


def files(*suffixes: str) -> list[Path]:
    """The definitions that came with rclpy; none where it is not installed."""
    share = install.folder() / "share"
    found = [path for suffix in suffixes for path in share.glob(f"*/{suffix}/*.{suffix}")]
    return sorted(path for path in found if path.with_suffix(".json").is_file())


@functools.cache
def hashes(path: Path) -> dict[str, str]:
    """The hashes of a type and of its parts, of the description that ROS 2 has computed."""
    described = json.loads(path.with_suffix(".json").read_text())
    return {each["type_name"]: each["hash_string"] for each in described["type_hashes"]}


def full(path: Path) -> str:
    return f"{path.parent.parent.name}/{path.parent.name}/{path.stem}"


def test_hashes(rclpy_process: RclpyPeer) -> None:
    compared = set()
    for path in files("msg", "srv", "action"):
        names, definitions = DefinitionFile(path).read(2)
        types, parts = TypeDescriptions(definitions), [definitions[each].fields for each in names]
        if path.suffix == ".srv":
            types.add_service(full(path), *parts)
        elif path.suffix == ".action":
            types.add_action(full(path), *parts)
        for name, expected in hashes(path).items():
            if name.startswith(full(path)):
                assert types.hash(name) == expected, name
                compared.add(name)
    assert len(compared) > 200
    for name in ("std_msgs/msg/String", "std_srvs/srv/SetBool_Event", "test_msgs/action/Fibonacci_SendGoal"):
        assert rclpy_process.ask("type_hash", type=name) in hashes(path_of(name)).values()


def path_of(name: str) -> Path:
    package, kind, cls = name.split("/")
    return install.folder() / "share" / package / kind / f"{cls.partition('_')[0]}.{kind}"


def test_bytes(rclpy_process: RclpyPeer) -> None:
    compared = 0
    for path in files("msg", "srv", "action"):
        names, definitions = DefinitionFile(path).read(2)
        types = RosTypes(2, definitions, known={})
        for name in names:
            name_in_ros = f"{path.parent.parent.name}/{path.parent.name}/{name.rpartition('/')[2]}"
            if name_in_ros not in [*REFUSED, "test_msgs/srv/Arrays_Request", "test_msgs/srv/Arrays_Response"]:
                compare(rclpy_process, name_in_ros, types.load(name))
                compared += 1
    assert compared > 150


def compare(peer: RclpyPeer, name: str, cls: type[r2p.Message]) -> None:
    """What r2p writes is what it reads after rclpy has written it."""
    codec, generator = cdr(cls), random.Random(name)
    data = [codec.encode(value(Nested(r2p.layout(cls)), generator)) for _ in range(EXAMPLES)]
    written = peer.ask("reserialize", type=name, data=[each.hex() for each in data])
    assert [codec.encode(codec.decode(bytes.fromhex(each))) for each in written] == data, name


def value(shape: Shape, generator: random.Random) -> Any:
    """Any value of a shape. Texts have no NUL, at which rclpy cuts them."""
    match shape:
        case FixedArray(item, count, container) | VariableArray(item, count, container):
            size = count if isinstance(shape, FixedArray) else generator.randint(0, min(count, 4))
            if container == "bytes":
                return generator.randbytes(size)
            items = [value(item, generator) for _ in range(size)]
            return Array(items) if container == "array" else tuple(items)
        case VariableText(limit):
            return "".join(generator.choices("aZ ~", k=generator.randint(0, min(limit, 9))))
        case Nested(layout):
            return layout.cls(**{field.name: value(field.shape, generator) for field in layout.fields})
        case Scalar("bool"):
            return generator.random() < 0.5
        case Scalar("f32" | "f64"):
            return generator.choice([0.0, -1.5, 3.0e38, 2.0**-140, float("inf")])
        case Scalar():
            return generator.choice([*shape.limits, generator.randint(*shape.limits)])
    raise AssertionError(shape)
