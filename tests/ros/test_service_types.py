"""Types of services and actions of r2p, and what ROS compares of them: the md5 sums and hashes that real ROS has."""

from typing import Annotated, Any

import pytest

import r2p
from r2p.messages import message_type
from r2p.ros import std_srvs
from r2p.ros.action_types import Action, CancelGoal, GoalState, GoalStatusArray, action_types, with_names
from r2p.ros.classes import RosTypes
from r2p.ros.definitions import parse_action, service_md5
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.library import DefinitionFile, ros2_hash
from r2p.ros.packages import Interface, packages
from r2p.ros.service_types import ServiceShape, service_shape, service_type
from r2p.ros.source import source_of_parts
from r2p.services.definition import Definition, define
from tests.ros.recorded import definitions, recorded

SUMS = {case["type"]: case["md5"] for case in recorded(1)["services"]}
HASHES = {case["type"]: case["hash"] for case in recorded(2)["service_hashes"]}
FIBONACCI = recorded(2)["action_hashes"][0]


class Point(r2p.Message, name="geometry_msgs/Point32"):
    x: r2p.f32 = 0.0
    y: r2p.f32 = 0.0
    z: r2p.f32 = 0.0


class Fibonacci(Action, name="test_msgs/Fibonacci"):
    class Goal(r2p.Message):
        order: r2p.i32 = 0

    class Result(r2p.Message):
        sequence: Annotated[r2p.Array[r2p.i32], r2p.Max(1000)] = r2p.Array()

    class Feedback(r2p.Message):
        sequence: Annotated[r2p.Array[r2p.i32], r2p.Max(1000)] = r2p.Array()


def shape_of(service: Any) -> ServiceShape:
    definition: Definition[Any, Any] = define("name", service)
    return service_shape(definition.requests, definition.responses)


@pytest.mark.parametrize("name", ["Empty", "SetBool", "Trigger"])
def test_sums_and_hashes_of_std_srvs(name: str) -> None:
    shape = shape_of(getattr(std_srvs, name))
    assert shape.name == f"std_srvs/{name}"
    assert service_type(shape, 1).checksum == SUMS[shape.name]
    if name != "Trigger":  # which is not in this part of the recording
        assert service_type(shape, 2).checksum == HASHES[f"std_srvs/srv/{name}"]
    assert service_type(shape, 2).name == shape.name


def recorded_service(name: str) -> ServiceShape:
    """A service of the recording, made of its definition as `r2p msg import` does."""
    types = RosTypes(2, definitions(2))
    short = name.replace("/srv/", "/")
    parts = [types.load(f"{short}_{part}") for part in ("Request", "Response")]
    definition: Definition[Any, Any] = define("name", *parts)
    return service_shape(definition.requests, definition.responses)


@pytest.mark.parametrize(
    "name", ["action_msgs/srv/CancelGoal", "nav_msgs/srv/GetMap", "rcl_interfaces/srv/SetParameters"]
)
def test_hashes_of_services_with_types_of_ros(name: str) -> None:
    """A ParameterValue has bytes, which the class does not tell from uint8."""
    assert service_type(recorded_service(name), 2).checksum == HASHES[name]


def test_hashes_of_an_action() -> None:
    types = action_types(Fibonacci)
    parts = FIBONACCI["parts"]
    assert types.name == "test_msgs/Fibonacci"
    assert service_type(shape_of(types.send_goal), 2).checksum == parts["SendGoal"]
    assert service_type(shape_of(types.get_result), 2).checksum == parts["GetResult"]
    assert shape_of(types.get_result).name == "test_msgs/action/Fibonacci_GetResult"
    assert ros2_hash(types.feedback_message) == parts["FeedbackMessage"]
    assert [ros2_hash(each) for each in (types.goal, types.result)] == [parts["Goal"], parts["Result"]]
    assert service_type(shape_of(CancelGoal), 2).checksum == HASHES["action_msgs/srv/CancelGoal"]
    assert ros2_hash(GoalStatusArray) == recorded(2)["types"]["action_msgs/msg/GoalStatusArray"]["hash"]
    assert action_types(Fibonacci) is types
    assert [state.name for state in GoalState if state.is_final] == ["SUCCEEDED", "CANCELED", "ABORTED"]


def test_an_imported_action_has_the_same_hashes(tmp_path: Any) -> None:
    (tmp_path / "test_msgs" / "action").mkdir(parents=True)
    file = tmp_path / "test_msgs" / "action" / "Fibonacci.action"
    file.write_text(FIBONACCI["definition"])
    names, found = DefinitionFile(file).read(2)
    assert names == [part.name for part in parse_action("test_msgs/action/Fibonacci", FIBONACCI["definition"])]
    types = RosTypes(2, found)
    text = source_of_parts(".action", [types.load(name) for name in names], found, 1000)
    made: dict[str, Any] = {}
    exec(text, made)  # noqa: S102 - the source is what is tested
    imported = action_types(made["Fibonacci"])
    assert ros2_hash(imported.feedback_message) == FIBONACCI["parts"]["FeedbackMessage"]
    assert r2p.layout(imported.goal).schema == r2p.layout(Fibonacci.Goal).schema


def test_types_that_are_learnt_from_a_schema() -> None:
    """A gateway that has no class of a service gets the names and schemas of its topics."""
    for service in (std_srvs.SetBool, std_srvs.Trigger, action_types(Fibonacci).send_goal):
        known: Definition[Any, Any] = define("name", service)
        learnt = [r2p.layout(message_type(each.name, each.schema)) for each in (known.requests, known.responses)]
        shape = service_shape(learnt[0], learnt[1])
        assert shape.name == shape_of(service).name
        assert shape.request.schema == known.request.schema
        assert service_type(shape, 1).checksum == service_type(shape_of(service), 1).checksum
        assert service_type(shape, 2).checksum == service_type(shape_of(service), 2).checksum
    message = r2p.layout(action_types(Fibonacci).feedback_message)
    named = with_names(message_type(message.name, message.schema))
    assert (r2p.layout(named).schema, ros2_hash(named)) == (message.schema, ros2_hash(message.cls))


def test_names() -> None:
    class Plain(r2p.Service):
        class Request(r2p.Message):
            data: bool = False

        class Response(r2p.Message):
            data: bool = False

    class Dock(Action):
        Goal = Fibonacci.Goal
        Result = Fibonacci.Result

        class Feedback(r2p.Message):
            distance: r2p.f32 = 0.0

    assert shape_of(Plain).name == "tests/Plain"
    assert action_types(Dock).name == "tests/Dock"
    assert r2p.layout(Dock.Goal).name == "test_msgs/action/Fibonacci_Goal"
    assert r2p.layout(Dock.Feedback).name == "tests/action/Dock_Feedback"
    with pytest.raises(r2p.MessageError, match="'SetBool' is not the full name of a service, such as std_srvs/SetBool"):
        type("Wrong", (r2p.Service,), {}, name="SetBool")
    with pytest.raises(r2p.MessageError, match="'a/srv/B' is not the full name of an action"):
        type("Wrong", (Action,), {}, name="a/srv/B")
    with pytest.raises(r2p.MessageError, match="action Half lacks a message class Result: nest `class Result"):
        action_types(type("Half", (Action,), {"Goal": Fibonacci.Goal}))
    with pytest.raises(r2p.MessageError, match="is not the type of a service's topic"):
        service_shape(r2p.layout(r2p.msg.Header), r2p.layout(r2p.msg.Header))


@pytest.mark.parametrize("version", [1, 2])
def test_packages_with_services_and_actions(tmp_path: Any, version: int) -> None:
    """What is read from their files has the sums and hashes of the classes."""

    class Home(r2p.Service, name="arm_msgs/Home"):
        class Request(r2p.Message):
            point: Point = Point()

        class Response(r2p.Message):
            angle: r2p.f32 = 0.0

    interfaces: list[Interface] = [("arm_msgs/srv/Home", [Home.Request, Home.Response])]
    if version == 2:
        types = action_types(Fibonacci)
        interfaces.append(("test_msgs/action/Fibonacci", [types.goal, types.result, types.feedback]))
    files = packages([], version, interfaces)
    assert "geometry_msgs" not in " ".join(files)
    assert "geometry_msgs" in files["arm_msgs/package.xml"]
    assert '"srv/Home.srv"' in files["arm_msgs/CMakeLists.txt"] or version == 1
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    names, found = DefinitionFile(tmp_path / "arm_msgs" / "srv" / "Home.srv").read(version)
    if version == 1:
        assert service_md5(names[0], names[1], found) == service_type(shape_of(Home), 1).checksum
        with pytest.raises(r2p.MessageError, match="the actions of ROS 1 are others"):
            packages([], 1, [("test_msgs/action/Fibonacci", [])])
    else:
        descriptions = TypeDescriptions(found)
        descriptions.add_service("arm_msgs/srv/Home", *(found[name].fields for name in names))
        assert descriptions.hash("arm_msgs/srv/Home") == service_type(shape_of(Home), 2).checksum
        assert files["test_msgs/action/Fibonacci.action"] == FIBONACCI["definition"]
        assert "<depend>action_msgs</depend>" in files["test_msgs/package.xml"]
