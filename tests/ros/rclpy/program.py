"""The process of rclpy: a command a line on its input, as JSON, and an answer or an event a line on its output.

A command is `{"id": 1, "do": "publish", ...}`, its answer `{"id": 1, "result": ...}` or `{"id": 1, "error": text}`.
What a subscriber receives comes as `{"topic": ..., "data": hex}`. Messages are bytes in hexadecimal, CDR, or values
as in the recorded vectors: `[int, ...]`, `{"hex": ...}` for octets, floats as numbers. Runs with rclpy's Python alone.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

_output = threading.Lock()


def emit(message: dict[str, Any]) -> None:
    with _output:
        sys.stdout.write(json.dumps(message) + "\n")
        sys.stdout.flush()


def interface(name: str) -> Any:
    """The class of `std_msgs/msg/String` or `std_srvs/srv/SetBool`, or of a part: `std_srvs/srv/SetBool_Request`."""
    package, kind, cls = name.split("/")
    found: Any = importlib.import_module(f"{package}.{kind}")
    if hasattr(found, cls):
        return getattr(found, cls)
    base, _, part = cls.partition("_")
    parts = getattr(found, base)
    if hasattr(parts, part):
        return getattr(parts, part)
    inner, _, last = part.partition("_")
    owner = getattr(parts.Impl, inner if inner == "FeedbackMessage" else f"{inner}Service")
    return getattr(owner, last) if last else owner


def type_hash(name: str) -> str:
    """The hash of an interface or of a part of one, from the description that its package has of it."""
    package, kind, cls = name.split("/")
    folder = Path(importlib.import_module(package).__file__ or "").parent
    base = cls if kind == "msg" else cls.partition("_")[0]
    for parent in folder.parents:
        found = parent / "share" / package / kind / f"{base}.json"
        if found.is_file():
            hashes = json.loads(found.read_text())["type_hashes"]
            return str(next(each["hash_string"] for each in hashes if each["type_name"] == name))
    raise LookupError(f"{name} has no description")


def plain(value: Any) -> Any:
    """A message as JSON has it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    if isinstance(value, array):
        return {"hex": value.tobytes().hex()} if value.typecode == "B" else list(value)
    if type(value).__module__ == "numpy":
        return {"hex": value.tobytes().hex()} if value.dtype == "uint8" else value.tolist()
    if isinstance(value, list | tuple):
        if value and isinstance(value[0], bytes):
            return {"hex": b"".join(value).hex()}
        return [plain(each) for each in value]
    return value


def fill(message: Any, values: dict[str, Any]) -> Any:
    """A message with these values; the fields that are not among them keep their defaults."""
    for name, value in values.items():
        setattr(message, name, _field(getattr(message, name), message.get_fields_and_field_types()[name], value))
    return message


def _field(old: Any, kind: str, value: Any) -> Any:
    if hasattr(old, "get_fields_and_field_types"):
        return fill(old, value)
    element = kind.removeprefix("sequence<").partition(">")[0].partition("[")[0].partition(",")[0]
    if isinstance(value, dict):
        octets = bytes.fromhex(value["hex"])
        if element == "octet":
            return octets if kind == "octet" else [bytes([each]) for each in octets]
        return array("B", octets) if kind.startswith("sequence") else list(octets)
    if isinstance(value, list) and "/" in element:
        package, cls = element.split("/")
        return [fill(interface(f"{package}/msg/{cls}")(), each) for each in value]
    return value


def qos(options: dict[str, Any]) -> QoSProfile:
    """`{"depth": 10, "reliable": true, "transient_local": false, "deadline": ns, "lifespan": ns}`, all optional."""
    profile = QoSProfile(depth=options.get("depth", 10))
    if not options.get("reliable", True):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if options.get("transient_local"):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    for name in ("deadline", "lifespan"):
        if options.get(name):
            setattr(profile, name, Duration(nanoseconds=options[name]))
    return profile


class Peer:
    """The commands. Each node has a name, and each entity belongs to the node that the command names."""

    def __init__(self) -> None:
        self.executor = MultiThreadedExecutor(2)
        self.nodes: dict[str, Node] = {}
        self.entities: dict[str, Any] = {}
        self.goals: dict[str, Any] = {}

    def node(self, name: str, namespace: str = "/", parameters: dict[str, Any] | None = None) -> list[str]:
        """Make a node, with parameters that it declares; return its services."""
        node = Node(name, namespace=namespace)
        for each, value in (parameters or {}).items():
            node.declare_parameter(each, value)
        self.nodes[name] = node
        self.executor.add_node(node)
        full = f"{namespace.rstrip('/')}/{name}"
        return sorted(each for each, _ in node.get_service_names_and_types() if each.startswith(f"{full}/"))

    def destroy(self, node: str) -> None:
        found = self.nodes.pop(node)
        self.executor.remove_node(found)
        for key in [key for key in self.entities if key.startswith(f"{node} ")]:
            entity = self.entities.pop(key)
            if isinstance(entity, ActionClient | ActionServer):
                entity.destroy()
        found.destroy_node()

    def destroy_all(self) -> None:
        for node in list(self.nodes):
            self.destroy(node)

    # topics

    def advertise(self, node: str, topic: str, type: str, qos: dict[str, Any] | None = None) -> None:
        """Publish a topic, and report how many subscribers it is connected to when that changes."""

        def matched(info: Any) -> None:
            emit({"matched": topic, "node": node, "count": info.current_count})

        events = PublisherEventCallbacks(matched=matched)
        publisher = self.nodes[node].create_publisher(interface(type), topic, _qos(qos), event_callbacks=events)
        self.entities[f"{node} pub {topic}"] = publisher

    def publish(
        self, node: str, topic: str, value: dict[str, Any] | None = None, data: str = "", count: int = 1
    ) -> None:
        publisher = self.entities[f"{node} pub {topic}"]
        message = bytes.fromhex(data) if data else fill(publisher.msg_type(), value or {})
        for _ in range(count):
            publisher.publish(message)

    def talk(self, node: str, topic: str, value: dict[str, Any], period: float = 0.1) -> None:
        """Publish a message again and again: the first ones reach no subscriber that is still being connected."""
        publisher = self.entities[f"{node} pub {topic}"]
        message = fill(publisher.msg_type(), value)
        self.nodes[node].create_timer(period, lambda: publisher.publish(message))

    def subscribe(
        self, node: str, topic: str, type: str, qos: dict[str, Any] | None = None, decode: bool = False
    ) -> None:
        """Report each message as bytes, or as a value with `decode`."""

        def arrived(message: Any) -> None:
            content = {"value": plain(message)} if decode else {"data": bytes(message).hex()}
            emit({"topic": topic, "node": node, **content})

        subscription = self.nodes[node].create_subscription(interface(type), topic, arrived, _qos(qos), raw=not decode)
        self.entities[f"{node} sub {topic}"] = subscription

    def withdraw(self, node: str, topic: str) -> None:
        self.nodes[node].destroy_publisher(self.entities.pop(f"{node} pub {topic}"))

    def unsubscribe(self, node: str, topic: str) -> None:
        self.nodes[node].destroy_subscription(self.entities.pop(f"{node} sub {topic}"))

    # the graph, as ros2's tools ask for it

    def graph(self, node: str) -> dict[str, Any]:
        asked = self.nodes[node]
        return {
            "nodes": sorted(f"{space.rstrip('/')}/{name}" for name, space in asked.get_node_names_and_namespaces()),
            "topics": dict(asked.get_topic_names_and_types()),
            "services": dict(asked.get_service_names_and_types()),
        }

    def endpoints(self, node: str, topic: str) -> dict[str, list[dict[str, Any]]]:
        asked = self.nodes[node]
        publishers = asked.get_publishers_info_by_topic(topic)
        subscribers = asked.get_subscriptions_info_by_topic(topic)
        return {"publishers": [*map(_endpoint, publishers)], "subscribers": [*map(_endpoint, subscribers)]}

    def topics_of(self, node: str, of: str) -> dict[str, Any]:
        """What a node publishes and subscribes to, as `ros2 node info` lists it."""
        asked, (namespace, _, name) = self.nodes[node], of.rpartition("/")
        publishers = asked.get_publisher_names_and_types_by_node(name, namespace or "/")
        subscribers = asked.get_subscriber_names_and_types_by_node(name, namespace or "/")
        return {"publishers": dict(publishers), "subscribers": dict(subscribers)}

    # services and actions

    def serve(self, node: str, service: str, type: str, response: dict[str, Any]) -> None:
        """Answer every request with one response."""
        cls = interface(type)

        def handle(request: Any, answer: Any) -> Any:
            emit({"service": service, "node": node, "value": plain(request)})
            return fill(answer, response)

        self.entities[f"{node} srv {service}"] = self.nodes[node].create_service(cls, service, handle)

    def call(self, node: str, service: str, type: str, request: dict[str, Any], timeout: float = 5.0) -> dict[str, Any]:
        """Call a service and return its response, as a value and as bytes."""
        cls = interface(type)
        client = self.nodes[node].create_client(cls, service)
        try:
            if not client.wait_for_service(timeout):
                raise TimeoutError(f"{service} has no server")
            answer = self._wait(client.call_async(fill(cls.Request(), request)), timeout)
            return {"value": plain(answer), "data": serialize_message(answer).hex()}
        finally:
            self.nodes[node].destroy_client(client)

    def act(
        self,
        node: str,
        action: str,
        type: str,
        feedback: list[dict[str, Any]],
        result: dict[str, Any],
        patience: float = 0.0,
    ) -> None:
        """Serve an action: every goal gets this feedback and this result; a cancellation is accepted.

        It waits for one up to `patience` seconds.
        """
        cls = interface(type)

        def execute(goal: Any) -> Any:
            for each in feedback:
                goal.publish_feedback(fill(cls.Feedback(), each))
            until = time.monotonic() + patience
            while time.monotonic() < until and not goal.is_cancel_requested:
                time.sleep(0.01)
            if goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.succeed()
            return fill(cls.Result(), result)

        self.entities[f"{node} act {action}"] = ActionServer(
            self.nodes[node], cls, action, execute, cancel_callback=lambda _goal: CancelResponse.ACCEPT
        )

    def send_goal(
        self, node: str, action: str, type: str, goal: dict[str, Any], timeout: float = 5.0
    ) -> dict[str, Any]:
        """Send a goal and wait for its result; feedback is reported as it comes."""
        cls = interface(type)
        client = ActionClient(self.nodes[node], cls, action)
        try:
            if not client.wait_for_server(timeout):
                raise TimeoutError(f"{action} has no server")

            def report(message: Any) -> None:
                emit({"action": action, "node": node, "value": plain(message.feedback)})

            handle = self._wait(client.send_goal_async(fill(cls.Goal(), goal), report), timeout)
            if not handle.accepted:
                return {"accepted": False}
            answer = self._wait(handle.get_result_async(), timeout)
            return {"accepted": True, "status": answer.status, "result": plain(answer.result)}
        finally:
            client.destroy()

    def _wait(self, future: Any, timeout: float) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _future: done.set())
        if not done.wait(timeout):
            raise TimeoutError(f"no answer within {timeout:g} s")
        return future.result()

    def set_parameters(self, node: str, values: dict[str, Any]) -> None:
        self.nodes[node].set_parameters([Parameter(name, value=value) for name, value in values.items()])

    # types and bytes

    def serialize(self, type: str, value: dict[str, Any]) -> str:
        return str(serialize_message(fill(interface(type)(), value)).hex())

    def deserialize(self, type: str, data: str) -> Any:
        return plain(deserialize_message(bytes.fromhex(data), interface(type)))

    def reserialize(self, type: str, data: list[str]) -> list[str]:
        """Return messages as this process writes what it has read of them."""
        cls = interface(type)
        return [serialize_message(deserialize_message(bytes.fromhex(each), cls)).hex() for each in data]

    def type_hash(self, type: str) -> str:
        return type_hash(type)


def _qos(options: dict[str, Any] | None) -> QoSProfile:
    return qos(options or {})


def _endpoint(info: Any) -> dict[str, Any]:
    profile = info.qos_profile
    return {
        "node": f"{info.node_namespace.rstrip('/')}/{info.node_name}",
        "type": info.topic_type,
        "hash": str(info.topic_type_hash),
        "gid": bytes(info.endpoint_gid).hex(),
        "reliable": profile.reliability == ReliabilityPolicy.RELIABLE,
        "transient_local": profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        "deadline": profile.deadline.nanoseconds,
        "lifespan": profile.lifespan.nanoseconds,
    }


def obey(peer: Peer, command: dict[str, Any]) -> None:
    number, name = command.pop("id"), command.pop("do")
    try:
        emit({"id": number, "result": getattr(peer, name)(**command)})
    except Exception as error:  # noqa: BLE001 - the test sees it
        emit({"id": number, "error": f"{type(error).__name__}: {error}"})


def spin(peer: Peer) -> None:
    """Run the callbacks. The executor breaks off where a node ends just as it begins to wait for it."""
    with contextlib.suppress(ExternalShutdownException):
        while rclpy.ok():
            with contextlib.suppress(InvalidHandle):
                peer.executor.spin()


def main() -> None:
    rclpy.init()
    peer = Peer()
    spinning = threading.Thread(target=spin, args=[peer])
    spinning.start()
    emit({"ready": rclpy.get_rmw_implementation_identifier()})
    for line in sys.stdin:
        obey(peer, json.loads(line))
    rclpy.shutdown()
    spinning.join()


if __name__ == "__main__":
    main()
