"""r2p parameters on a ROS 2 network, against what a node of rclpy answered, and plain ROS nodes of an in-memory one."""

import asyncio
import contextlib
import enum
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.ros import parameter_messages as messages
from r2p.ros import type_descriptions
from r2p.ros.cdr import cdr
from r2p.ros.middleware import Qos
from r2p.ros.options import RosOptions
from r2p.ros.parameters import EVENTS, ParameterTransport
from r2p.testing.network import Network
from tests.ros.fake import FakeMiddleware, FakeRosNetwork, RosNode
from tests.ros.recorded import recorded

NODE = "/robot/params_node"
NOT_IN_R2P = {"raw", "flags", "names", "free", "unset", "typed"}
"""Parameters of the recorded node that r2p has no kind for: arrays of bytes, bools and texts, values of any type, and
values that are missing. Its node here has none of these names, so they are unknown.
"""


def ranged(step: int = 0) -> dict[str, Any]:
    return {"integer_range": (parameter_class("IntegerRange")(from_value=0, to_value=10, step=step),)}


SERVICES = (*messages.SERVICE_NAMES, type_descriptions.NAME)
OTHER_ANSWERS: dict[str, Callable[[Any], bool]] = {
    # r2p has no steps, and no texts for constraints
    "describe ranged": lambda answer: answer.descriptors[0].integer_range == ranged()["integer_range"],
    "describe franged": lambda answer: answer.descriptors[0].additional_constraints == "",
    # a tuple of r2p keeps its length, which the description says
    "several": lambda answer: answer.descriptors[1].additional_constraints == "2 numbers",
    "all arrays": lambda answer: [each.successful for each in answer.results] == [False] * 4,
    # it takes an integer for a double, such as that of `ros2 param set /node gain 2`
    "int for a double": lambda answer: answer.results[0].successful,
    # rclpy declares a parameter without a name
    "empty name": lambda answer: not answer.results[0].successful,
}
"""What r2p answers otherwise, and why."""


def parameter_class(name: str) -> Any:
    return messages.message_class(name)


async def declare(node: r2p.Node) -> None:
    """The parameters of the recorded node, as far as r2p has them."""
    node.parameter("flag", True)
    node.parameter("count", 7)
    node.parameter("gain", 1.5)
    node.parameter("label", "grüße")
    node.parameter("ids", (1, 2, 3))
    node.parameter("gains", (0.5, 1.5))
    node.parameter("group.inner.deep", 1)
    node.parameter("group.other", 2)
    node.parameter("limited", 5, check=lambda value: "limited must not exceed 100" if value > 100 else None)
    node.parameter("fixed", 3, read_only=True, doc="cannot change")
    node.parameter("ranged", 5, min=0, max=10, doc="0 to 10 step 5")
    node.parameter("franged", 0.5, min=0.0, max=1.0)
    await asyncio.get_running_loop().create_future()


def transport(network: FakeRosNetwork, **options: Any) -> ParameterTransport:
    return ParameterTransport("ros2:", lambda _hub: FakeMiddleware(network), RosOptions(**options))


class Tool:
    """A ROS node that calls the services of another node, and listens to its events."""

    def __init__(self, network: FakeRosNetwork, node: str = NODE) -> None:
        self.ros: RosNode = network.node("/tool")
        self.node = node
        self.events = self.ros.subscribe(EVENTS, parameter_class("ParameterEvent"), type=messages.event_type())

    async def call(self, name: str, **fields: Any) -> Any:
        service = messages.service(name)
        request = service.request.encode(request_class(name)(**fields))
        return service.response.decode(await self.ros.call(f"{self.node}/{name}", request))

    async def set(self, **values: Any) -> list[tuple[bool, str]]:
        parameters = tuple(parameter_class("Parameter")(name=name, value=value) for name, value in values.items())
        answer = await self.call("set_parameters", parameters=parameters)
        return [(each.successful, each.reason) for each in answer.results]


def request_class(name: str) -> Any:
    return parameter_class(f"{messages.SERVICE_NAMES[name]}_Request")


def ros_value(**fields: Any) -> Any:
    return parameter_class("ParameterValue")(**fields)


@contextlib.asynccontextmanager
async def recorded_node(*, alone: bool = False, **options: Any) -> AsyncIterator[Tool]:
    """A module with a node that has parameters, or one `alone`, which is a ROS node itself."""
    network = FakeRosNetwork(2)
    async with r2p.Module("PC1", via=transport(network, ns="/robot"), **options) as module:
        if not alone:
            module.start(declare, name="params_node")
        tool = Tool(network)
        await asyncio.sleep(2)
        yield tool


@pytest.mark.virtual_time
async def test_the_recorded_calls_of_a_node_of_rclpy() -> None:
    """In their order, as some of them change values that others read; and with the events that follow."""
    compared, events = set(), list[Any]()
    async with recorded_node(allow_control=True) as tool:
        for case in recorded(2)["parameter_calls"]:
            name = case["service"].rpartition("/")[2]
            service = messages.service(name)
            data = bytes.fromhex(case["request"]["bytes"])
            tool.events.clear()
            answer = service.response.decode(await tool.ros.call(case["service"], data))
            expected = service.response.decode(bytes.fromhex(case["response"]["bytes"]))
            await asyncio.sleep(0.01)
            if case["note"] in OTHER_ANSWERS:
                assert OTHER_ANSWERS[case["note"]](answer), case["note"]
                assert answer != expected
                compared.add(case["note"])
            else:
                assert meaning(name, answer) == as_r2p(name, service.request.decode(data), meaning(name, expected))
                assert bool(tool.events) == (name.startswith("set_") and any(meaning(name, answer)))
            events += [changed(each) for each in tool.events]
    assert compared == OTHER_ANSWERS.keys()
    codec = cdr(parameter_class("ParameterEvent"))
    theirs = {each["style"]: codec.decode(bytes.fromhex(each["bytes"])) for each in recorded(2)["parameter_events"]}
    # The others are of calls that are not in the recording, or of parameters and answers that are not in r2p.
    assert [style for style, event in theirs.items() if changed(event) in events] == [
        "after_call_40",  # of a value that the parameter has already
        "after_call_61",  # of several at once
        "after_call_64",  # of none, set all the same
    ]


def meaning(name: str, answer: Any) -> Any:
    """What an answer says; the text of a refusal is r2p's own."""
    if name == "list_parameters":
        return list(answer.result.names), set(answer.result.prefixes)
    if name.startswith("set_"):
        results = answer.results if name == "set_parameters" else [answer.result]
        assert all(bool(each.reason) != each.successful for each in results)
        return [each.successful for each in results]
    return next(iter(getattr(answer, field) for field in answer.__struct_fields__))


def as_r2p(name: str, request: Any, expected: Any) -> Any:
    """An answer without the parameters that are not in r2p: unknown ones leave nothing of it."""
    if name == "list_parameters":
        return [each for each in expected[0] if each not in NOT_IN_R2P], expected[1]
    if name.startswith("set_"):
        names = [each.name for each in request.parameters]
        return [ok and not NOT_IN_R2P & {each} for ok, each in zip(expected, names, strict=False)] or expected
    return type(expected)() if NOT_IN_R2P & set(request.names) else expected


def changed(event: Any) -> tuple[Any, ...]:
    return event.node, event.new_parameters, event.changed_parameters, event.deleted_parameters


@pytest.mark.virtual_time
async def test_every_node_has_the_services_and_two_parameters_of_ros() -> None:
    async with recorded_node() as tool:
        graph = tool.ros.network.graph(tool.ros)
        served = {(each.node, each.service.rpartition("/")[2]) for each in graph.servers}
        assert served == {(NODE, name) for name in SERVICES}
        for entry in recorded(2)["service_hashes"]:
            for server in graph.servers:
                if entry["type"] == server.type.replace("/", "/srv/"):
                    assert server.checksum == entry["hash"]
        events = [each for each in graph.publishers if each.topic == EVENTS]
        assert {(each.node, each.qos) for each in events} >= {(NODE, Qos(depth=1000))}
        request = type_descriptions.request_for("rcl_interfaces/ParameterEvent", messages.event_type().checksum)
        described = await tool.ros.call(f"{NODE}/{type_descriptions.NAME}", request)
        assert "Parameter[] changed_parameters" in type_descriptions.definition_in(described)
    async with recorded_node(alone=True) as tool:
        tool.node = "/robot/PC1"
        answer = await tool.call("list_parameters")
        assert answer.result.names == ("use_sim_time", "start_type_description_service")
        assert await tool.set(use_sim_time=ros_value(type=1)) == [(True, "")]
        ((successful, reason),) = await tool.set(use_sim_time=ros_value(type=1, bool_value=True))
        assert (successful, "one that calls r2p.sim.run(main, follow=True) has that of /clock" in reason) == (
            False,
            True,
        )


@pytest.mark.virtual_time
async def test_sets_need_permission_and_refusals_say_why() -> None:
    async with recorded_node() as tool:
        ((successful, reason),) = await tool.set(count=ros_value(type=2, integer_value=8))
        assert (successful, "--allow-control" in reason) == (False, True)
    async with recorded_node(allow_control=True) as tool:
        results = await tool.set(
            count=ros_value(type=4, string_value="x"),
            gian=ros_value(type=3),
            fixed=ros_value(type=2, integer_value=4),
            limited=ros_value(type=2, integer_value=101),
            ranged=ros_value(type=2, integer_value=11),
            label=ros_value(type=77),
            flag=ros_value(type=0),
        )
        assert results == [
            (False, "count: it takes an integer, not a string"),
            (False, "/robot/params_node has no parameter 'gian'; did you mean gain?"),
            (False, "PC1/params_node.fixed is read-only: only its own node sets it"),
            (False, "PC1/params_node.limited = 101: limited must not exceed 100"),
            (False, "PC1/params_node.ranged = 11: it takes 10 or less"),
            (False, "label: it takes a string, and 77 is not the number of a type"),
            (False, "flag: it can't be deleted: r2p param reset gives it the value of its start"),
        ]
        with pytest.raises(r2p.ServiceError, match="can't be read"):
            await tool.ros.call(f"{NODE}/set_parameters", b"\0\1\0\0\xff\xff\xff\xff")


async def steer(node: r2p.Node) -> None:
    class Mode(enum.Enum):
        AUTO = 1
        MANUAL = 2

    gain = node.parameter("gain", 1.0, min=0.0, unit="V", doc="of the controller")
    node.parameter("mode", Mode.AUTO)
    await asyncio.sleep(5)
    gain.set(2.0)
    await asyncio.get_running_loop().create_future()


@pytest.mark.virtual_time
async def test_what_a_program_sets_itself_is_an_event() -> None:
    network = FakeRosNetwork(2)
    async with r2p.Module("PC1", via=transport(network)) as module:
        module.start(steer)
        tool = Tool(network, "/steer")
        await asyncio.sleep(6)
        assert [names(each.changed_parameters) for each in tool.events if each.node == "/steer"][-1:] == [("gain",)]
        first = tool.events[0]
        assert (first.node, names(first.new_parameters)[2:]) == ("/steer", ("gain", "mode"))
        described = (await tool.call("describe_parameters", names=("gain", "mode"))).descriptors
        assert (described[0].description, described[0].floating_point_range[0].from_value) == (
            "of the controller [V]",
            0.0,
        )
        assert (described[1].type, described[1].additional_constraints) == (messages.STRING, "one of AUTO, MANUAL")


def names(parameters: Any) -> tuple[str, ...]:
    return tuple(each.name for each in parameters)


@pytest.mark.parametrize("ros_nodes", [False, True])
@pytest.mark.virtual_time
async def test_parameters_behind_a_gateway(ros_nodes: bool) -> None:
    network, bus = FakeRosNetwork(2), Network()
    via = [bus.transport(), transport(network, ros_nodes=ros_nodes)]
    gateway = r2p.Module("GW", via=via, bridge=r2p.BridgeOptions(allow_control=True))
    async with gateway, r2p.Module("MOTOR", via=bus.transport()) as motor:
        motor.start(steer)
        await asyncio.sleep(8)
        tool = Tool(network, "/MOTOR/steer" if ros_nodes else "/GW")
        prefix = "" if ros_nodes else "MOTOR.steer."
        listed = (await tool.call("list_parameters")).result
        assert [each for each in listed.names if "gain" in each or "mode" in each] == [f"{prefix}gain", f"{prefix}mode"]
        gain, mode = (f"{prefix}{each}" for each in ("gain", "mode"))
        assert await tool.set(**{gain: ros_value(type=3, double_value=0.5)}) == [(True, "")]
        assert motor.parameters["steer", "gain"].value == 0.5
        both = {gain: ros_value(type=3, double_value=3.0), mode: ros_value(type=4, string_value="NONE")}
        parameters = tuple(parameter_class("Parameter")(name=name, value=value) for name, value in both.items())
        result = (await tool.call("set_parameters_atomically", parameters=parameters)).result
        assert (result.successful, "it takes one of AUTO, MANUAL" in result.reason) == (False, True)
        assert motor.parameters["steer", "gain"].value == 0.5
        assert (await tool.call("get_parameters", names=(gain,))).values[0].double_value == 0.5


@pytest.mark.virtual_time
async def test_requests_that_would_keep_a_node_busy_are_refused() -> None:
    """Many names, each of which is looked at or answered; many bytes; and a name of which a similar one is sought."""
    async with recorded_node(allow_control=True) as tool:
        for name, field, value in (
            ("list_parameters", "prefixes", "g"),
            ("get_parameters", "names", "flag"),
            ("describe_parameters", "names", "flag"),
            ("set_parameters", "parameters", parameter_class("Parameter")(name="x")),
        ):
            with pytest.raises(r2p.ServiceError, match="it has 3000 names, more than 2000"):
                await tool.call(name, **{field: (value,) * 3000})
        with pytest.raises(r2p.ServiceError, match="more than 1048576"):
            await tool.call("get_parameters", names=("x" * (1 << 20),))
        ((successful, reason),) = await tool.set(**{"x" * 500_000: ros_value(type=1)})
        assert (successful, len(reason) < 1000) == (False, True)
        for value in (ros_value(type=77), ros_value(type=3, double_value=float("nan"))):
            ((successful, reason),) = await tool.set(gain=value)
            assert (successful, bool(reason)) == (False, True)


@given(st.binary(max_size=60), st.sampled_from(sorted(messages.SERVICE_NAMES)))
def test_requests_of_any_bytes_never_raise_anything_else(data: bytes, name: str) -> None:
    codec = messages.service(name).request
    for request in (data, b"\0\1\0\0" + data):
        with contextlib.suppress(r2p.DecodeError):
            codec.decode(request)


@pytest.mark.parametrize(
    ("prefixes", "depth", "found", "parents"),
    [
        ([], 0, ["a", "g.b", "g.h.c", "gg.d"], ["g", "g.h", "gg"]),
        ([], 1, ["a"], []),
        (["g"], 1, ["g.b"], ["g"]),
        (["g.h", "a"], 0, ["a", "g.h.c"], ["g.h"]),
        (["g."], 0, [], []),
    ],
)
def test_lists(prefixes: list[str], depth: int, found: list[str], parents: list[str]) -> None:
    assert messages.listed(["a", "g.b", "g.h.c", "gg.d"], prefixes, depth) == (found, parents)
