"""A rospy node that does what lines of JSON on its standard input say; run by Debian's Python, not by the tests'.

A line is `{"id": 7, "do": "publish", "topic": "/chat", "fields": {"data": "hi"}}`; the answer is `{"id": 7, "result":
...}` or `{"id": 7, "error": "..."}`. Each line has a thread of its own, so that one can wait for another's effect.
Messages are JSON objects, times `{"secs": 1, "nsecs": 2}`, bytes lists of numbers.
"""

import json
import os
import sys
import threading
from collections import defaultdict
from typing import Any

import genpy.message
import roslib.message
import rospy

_WAIT = 30.0
"""Seconds after which the test has failed."""

_publishers: dict[str, Any] = {}
_subscribers: dict[str, Any] = {}
_servers: dict[str, Any] = {}
_received: dict[str, list[Any]] = defaultdict(list)
_counts: dict[str, int] = defaultdict(int)
_changed = threading.Condition()


def advertise(topic: str, type: str, latch: bool = False, queue: int = 100) -> None:
    _publishers[topic] = rospy.Publisher(topic, _message_class(type), latch=latch, queue_size=queue, tcp_nodelay=True)


def unadvertise(topic: str) -> None:
    _publishers.pop(topic).unregister()


def publish(topic: str, fields: Any, count: int = 1) -> None:
    """Publish a message `count` times, as fast as that goes."""
    publisher = _publishers[topic]
    message = _filled(publisher.data_class(), fields)
    for _ in range(count):
        publisher.publish(message)


def connected(topic: str, count: int = 1) -> None:
    """Wait until a publisher or subscriber has `count` connections."""
    end = _publishers.get(topic) or _subscribers[topic]
    for _ in range(round(_WAIT / 0.005)):
        if end.get_num_connections() == count:
            return
        threading.Event().wait(0.005)
    raise TimeoutError(f"{end.get_num_connections()} connections of {topic} instead of {count}")


def subscribe(topic: str, type: str, count_only: bool = False) -> None:
    """Keep what arrives for `messages`, or only count it for `counted`."""

    def arrived(message: Any) -> None:
        with _changed:
            if not count_only:
                header = getattr(message, "_connection_header", {})
                _received[topic].append({"message": _plain(message), "header": header})
            _counts[topic] += 1
            _changed.notify_all()

    _received.pop(topic, None)
    _counts.pop(topic, None)
    _subscribers[topic] = rospy.Subscriber(topic, _message_class(type), arrived, tcp_nodelay=True)


def unsubscribe(topic: str) -> None:
    _subscribers.pop(topic).unregister()


def messages(topic: str, count: int = 1) -> Any:
    """Wait for `count` messages and return them; they are forgotten."""
    with _changed:
        if not _changed.wait_for(lambda: len(_received[topic]) >= count, _WAIT):
            raise TimeoutError(f"{len(_received[topic])} messages on {topic} instead of {count}")
        taken, _received[topic] = _received[topic][:count], _received[topic][count:]
        return taken


def counted(topic: str, count: int) -> int:
    """Wait until `count` messages have arrived since `subscribe`."""
    with _changed:
        if not _changed.wait_for(lambda: _counts[topic] >= count, _WAIT):
            raise TimeoutError(f"{_counts[topic]} messages on {topic} instead of {count}")
        return _counts[topic]


def serve(service: str, type: str, fields: Any = None, error: str = "") -> None:
    """Answer each request with the same response, or with an error."""
    cls = roslib.message.get_service_class(type)

    def handle(request: Any) -> Any:
        with _changed:
            _received[service].append({"message": _plain(request), "header": {}})
            _changed.notify_all()
        if error:
            raise rospy.ServiceException(error)
        return _filled(cls._response_class(), fields or {})

    _received.pop(service, None)
    _servers[service] = rospy.Service(service, cls, handle)


def unserve(service: str) -> None:
    _servers.pop(service).shutdown("")


def call(service: str, type: str, fields: Any, count: int = 1, persistent: bool = False) -> Any:
    """Call a service `count` times and return the last response; errors come back as such."""
    rospy.wait_for_service(service, _WAIT)
    proxy = rospy.ServiceProxy(service, roslib.message.get_service_class(type), persistent)
    request = _filled(proxy.request_class(), fields)
    for _ in range(count):
        response = proxy(request)
    return _plain(response)


def now() -> float:
    return float(rospy.get_time())


def sleep(seconds: float) -> float:
    """Sleep in ROS's time, return when that ended."""
    rospy.sleep(seconds)
    return now()


def get_param(name: str, default: Any = None) -> Any:
    return rospy.get_param(name, default)


def set_param(name: str, value: Any) -> None:
    rospy.set_param(name, value)


def topics() -> Any:
    return rospy.get_published_topics()


def log(level: str, text: str) -> None:
    getattr(rospy, f"log{level}")(text)


def _message_class(type: str) -> Any:
    return rospy.AnyMsg if type == "*" else roslib.message.get_message_class(type)


def _filled(message: Any, fields: Any) -> Any:
    genpy.message.fill_message_args(message, [fields])
    return message


def _plain(value: Any) -> Any:
    if isinstance(value, rospy.AnyMsg):
        return list(value._buff)
    if isinstance(value, genpy.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: _plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, bytes | list | tuple):
        return [_plain(each) for each in value]
    return value


_ALL = (advertise, unadvertise, publish, connected, subscribe, unsubscribe, messages, counted, serve, unserve, call)
_MORE = (now, sleep, get_param, set_param, topics, log)
_COMMANDS = {each.__name__: each for each in (*_ALL, *_MORE)}


def _obey(line: str, answers: Any) -> None:
    command = json.loads(line)
    number, name = command.pop("id"), command.pop("do")
    try:
        answer = {"id": number, "result": _COMMANDS[name](**command)}
    except Exception as error:  # noqa: BLE001
        answer = {"id": number, "error": f"{type(error).__name__}: {error}"}
    answers.write(json.dumps(answer) + "\n")


def main() -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # rospy prints what it logs
    rospy.init_node(sys.argv[1], disable_signals=True)
    answers.write(json.dumps({"id": 0, "result": None}) + "\n")
    for line in sys.stdin:
        threading.Thread(target=_obey, args=(line, answers), daemon=True).start()
    rospy.signal_shutdown("the tests are done")


if __name__ == "__main__":
    main()
