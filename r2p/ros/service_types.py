"""Types of services in ROS, made of the types of the two topics that a service of r2p is.

    Calibrate(r2p.Service, name="arm_msgs/Calibrate")
    topics    arm_msgs/Calibrate_Request_q, arm_msgs/Calibrate_Response_r      the header, then request or response
    ROS       arm_msgs/Calibrate, its md5 of both parts (ROS 1) or the hash of arm_msgs/srv/Calibrate (ROS 2)

A service without a class of its own is named after the type of its requests. Those of an action have their kind in the
name, as `test_msgs/action/Fibonacci_SendGoal`.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import msgspec

from r2p.codecs.services import HEADER_SIZE, REQUESTS
from r2p.errors import MessageError
from r2p.messages import Layout, Message, Nested, layout, show
from r2p.ros.action_types import with_names
from r2p.ros.cdr import cdr
from r2p.ros.definitions import service_md5
from r2p.ros.hashes import service_hash
from r2p.ros.library import definitions_with_those_of_ros
from r2p.ros.middleware import RosService
from r2p.ros.type_names import ros2_name
from r2p.services.definition import Definition

Convert: TypeAlias = Callable[[bytes], bytes]


class _Nothing(Message, name="std_srvs/srv/Empty_Request"):
    """A request or response without fields."""


class ServiceShape(msgspec.Struct, frozen=True, eq=False):
    """A service: the name of its type, the layouts of request and response, and those of its two topics."""

    name: str
    request: Layout[Any]
    response: Layout[Any]
    requests: Layout[Any]
    responses: Layout[Any]

    def definition(self, name: str) -> Definition[Any, Any]:
        """Return the definition of a service of this type in r2p."""
        return Definition(name, self.request, self.response, self.requests, self.responses)


def service_shape(requests: Layout[Any], responses: Layout[Any]) -> ServiceShape:
    """Return the service of which these are the layouts of the topics NAME_q and NAME_r.

    They may be learnt from another module, with made-up names inside. Raises MessageError if they are not of a service.
    """
    name = requests.name.removesuffix(REQUESTS).removesuffix("Request").removesuffix("_")
    request, response = (
        layout(with_names(_body(each).cls, f"{ros2_name(name, 'srv')}_{part}"))
        for each, part in ((requests, "Request"), (responses, "Response"))
    )
    return ServiceShape(name, request, response, requests, responses)


def _body(topic: Layout[Any]) -> Layout[Any]:
    """Return the layout of the one field behind the header; a schema does not show one without fields."""
    last = topic.fields[-1] if topic.fields else None
    if last is not None and isinstance(last.shape, Nested):
        return last.shape.layout
    if topic.exact_size == HEADER_SIZE:
        return layout(_Nothing)
    raise MessageError(f"{show(topic.name)} is not the type of a service's topic")


def service_type(shape: ServiceShape, version: int) -> RosService:
    """Return the type of a service in ROS 1 or 2 (`version`). Raises MessageError for types that ROS can't define."""
    request, response = shape.request, shape.response
    found = definitions_with_those_of_ros(request.cls, version) | definitions_with_those_of_ros(response.cls, version)
    if version == 1:
        return RosService(shape.name, service_md5(request.name, response.name, found))
    fields = found[request.name].fields, found[response.name].fields
    return RosService(shape.name, service_hash(shape.name, *fields, found))


# Bytes


class RosServiceCodec(msgspec.Struct, frozen=True, eq=False):
    """A service between the two sides: its shape here, its type there, and what makes one's bytes of the other's.

    The functions raise DecodeError for bytes that are not of the type, and MessageError for what the other side has no
    room for.
    """

    shape: ServiceShape
    type: RosService
    request_to_ros: Convert
    request_from_ros: Convert
    response_to_ros: Convert
    response_from_ros: Convert


def service_codec(shape: ServiceShape, version: int) -> RosServiceCodec:
    """Return the codec of a service in ROS 1 or 2 (`version`). Raises MessageError for types that ROS can't define."""
    parts = (*_convert(shape.request, version), *_convert(shape.response, version))
    return RosServiceCodec(shape, service_type(shape, version), *parts)


def _convert(part: Layout[Any], version: int) -> tuple[Convert, Convert]:
    """Return what makes bytes of ROS of packed ones, and the other way around; those of ROS 1 are the same."""
    if version == 1:
        return bytes, functools.partial(_checked, part)
    cls: type[Message] = part.cls
    codec, encode, decode = cdr(cls), part.encode, part.decode
    return lambda data: codec.encode(decode(data)), lambda data: encode(codec.decode(data))


def _checked(part: Layout[Any], data: bytes) -> bytes:
    part.decode(data)
    return bytes(data)
