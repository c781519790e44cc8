"""ROS 2's service that describes types: of r2p's classes, and of ROS nodes whose types nobody here has."""

import asyncio
import contextlib
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.errors import DecodeError
from r2p.ros.action_types import GoalStatusArray
from r2p.ros.definitions import parse
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.library import ros2_hash
from r2p.ros.type_descriptions import definition_in, describe, request_for, response_with, service
from tests.ros.fake import FakeRosNetwork
from tests.ros.recorded import definitions, recorded


class Wheel(r2p.Message, name="cart_msgs/Wheel"):
    speed: r2p.f32 = 0.0
    name: Annotated[str, r2p.Max(20)] = ""


class Cart(r2p.Message, name="cart_msgs/Cart"):
    wheels: Annotated[tuple[Wheel, ...], r2p.Len(4)] = (Wheel(),) * 4
    stamp: r2p.Timestamp = r2p.Timestamp()
    spare: Annotated[tuple[Wheel, ...], r2p.Max(9)] = ()


def test_the_service_has_the_hash_of_real_ros() -> None:
    types = recorded(2)["types"]
    parts = TypeDescriptions(definitions(2))
    for part in ("Request", "Response"):
        name = f"type_description_interfaces/srv/GetTypeDescription_{part}"
        parts.add(name, definitions(2)[f"type_description_interfaces/GetTypeDescription_{part}"].fields)
        assert parts.hash(name) == types[name]["hash"]
    assert service().checksum == "RIHS01_69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"


@pytest.mark.parametrize("cls", [Cart, GoalStatusArray])
def test_a_class_is_described_so_that_others_compute_its_hash(cls: type[r2p.Message]) -> None:
    name, checksum = r2p.layout(cls).name, ros2_hash(cls)
    text = definition_in(describe(request_for(name, checksum), [Wheel, cls]))
    assert TypeDescriptions(parse(name, text)).hash(name) == checksum
    assert definition_in(describe(request_for(name, "RIHS01_0"), [cls])) == ""
    assert definition_in(describe(request_for("cart_msgs/Boat", ""), [cls])) == ""


def test_descriptions_of_recorded_types_have_all_that_their_hashes_are_made_of() -> None:
    """Also bounds, and bytes, which a class does not tell from numbers."""
    types, compared = TypeDescriptions(definitions(2)), 0
    for name, case in recorded(2)["types"].items():
        if "/msg/" in name:
            text = definition_in(response_with(types.description(name), {}))
            assert TypeDescriptions(parse(name, text)).hash(name) == case["hash"], name
            compared += 1
    assert compared > 60


@given(st.binary(max_size=200))
def test_hostile_bytes(data: bytes) -> None:
    for read in (definition_in, lambda given: describe(given, [Cart])):
        with contextlib.suppress(DecodeError):
            read(b"\x00\x01\x00\x00" + data)


@pytest.mark.virtual_time
async def test_a_tool_reads_a_type_that_only_a_ros_node_has() -> None:
    network = FakeRosNetwork(2)
    talker = network.node("/cart")

    async def handler(request: bytes) -> bytes:
        return describe(request, [Cart])

    talker.serve("/cart/get_type_description", service(), handler)
    cart = Cart(wheels=(Wheel(1.5, "left"),) * 4)
    talker.advertise("/cart", Cart)
    async with r2p.Module("TOOL", via=network.transport(), observer=True) as module:
        await asyncio.sleep(2)
        view = module.network.topics()["cart"]
        assert view.fingerprint == r2p.layout(Cart).fingerprint
        found = await module.links[0].message_type(view.fingerprint)
        assert found is not None
        assert r2p.layout(found).schema == r2p.layout(Cart).schema
        assert r2p.layout(found).name == "cart_msgs/Cart"
        assert found.decode(cart.encode()).encode() == cart.encode()
