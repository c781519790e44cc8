"""A program of zenoh-ros2-sdk, which shares no code with r2p: `python -m tests.ros.ros2.sdk_program PORT`.

It takes commands as lines of JSON, `["publish", "/chatter", "hi"]`, and answers each with a line, `{"result": ...}`.
What its subscribers receive and its servers are asked are lines in between: `{"received": ["/chatter", "hi"]}`.
"""

import dataclasses
import json
import logging
import sys
import threading
from typing import Any

import zenoh_ros2_sdk as sdk
from zenoh_ros2_sdk import discovery
from zenoh_ros2_sdk.session import ZenohSession

STRING, STRING_TEXT = "std_msgs/msg/String", "string data"
SET_BOOL = "std_srvs/srv/SetBool"
SET_BOOL_TEXTS = {"request_definition": "bool data", "response_definition": "bool success\nstring message"}


class Program:
    """What the commands do, by name."""

    def __init__(self, port: int) -> None:
        self._at = {"router_ip": "127.0.0.1", "router_port": port}
        self._publishers: dict[str, Any] = {}
        self._kept: list[Any] = []
        self._writing = threading.Lock()

    def say(self, **line: Any) -> None:
        with self._writing:
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()

    def advertise(self, topic: str, node: str, qos: str | None) -> None:
        named = {"node_name": node, "msg_definition": STRING_TEXT, "qos": qos}
        self._publishers[topic] = sdk.ROS2Publisher(topic, STRING, **named, **self._at)

    def publish(self, topic: str, text: str) -> None:
        self._publishers[topic].publish(data=text)

    def withdraw(self, topic: str) -> None:
        self._publishers.pop(topic).close()

    def subscribe(self, topic: str, node: str, qos: str | None) -> None:
        named = {"node_name": node, "msg_definition": STRING_TEXT, "qos": qos}
        received = lambda message: self.say(received=[topic, message.data])  # noqa: E731
        self._kept.append(sdk.ROS2Subscriber(topic, STRING, received, **named, **self._at))

    def serve(self, service: str, node: str) -> None:
        """Serve a SetBool, which succeeds if its data is true."""

        def handle(request: Any) -> Any:
            self.say(asked=[service, request.data])
            return server.response_msg_class(success=request.data, message=f"it is {request.data}")

        server: Any = sdk.ROS2ServiceServer(
            service, SET_BOOL, callback=handle, node_name=node, **SET_BOOL_TEXTS, **self._at
        )
        self._kept.append(server)

    def call(self, service: str, node: str, data: bool) -> list[Any] | None:
        client = sdk.ROS2ServiceClient(service, SET_BOOL, node_name=node, timeout=5.0, **SET_BOOL_TEXTS, **self._at)
        response: Any = client.call(data=data)
        client.close()
        return None if response is None else [response.success, response.message]

    def topics(self) -> dict[str, list[str]]:
        return dict(discovery.get_topic_names_and_types(domain_id=0, **self._at))

    def services(self) -> dict[str, list[str]]:
        return dict(discovery.get_service_names_and_types(domain_id=0, **self._at))

    def topic_info(self, topic: str) -> Any:
        return dataclasses.asdict(discovery.get_topic_info(topic, domain_id=0, verbose=True, **self._at))


def main(port: int) -> None:
    logging.disable(logging.WARNING)
    program = Program(port)
    program.say(result="ready")
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        try:
            program.say(result=getattr(program, name)(*arguments))
        except Exception as error:  # noqa: BLE001 - the test shows it
            program.say(error=repr(error))
    ZenohSession.get_instance().close()


if __name__ == "__main__":
    main(int(sys.argv[1]))
