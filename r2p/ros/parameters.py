"""r2p parameters on a ROS 2 network: `ros2 param list`, `get`, `set`, `describe` and `dump` of each node, and what
programs do with `/parameter_events`.

Each ROS node of a link has six services, which read and set the parameters of the r2p node that it stands for, and one
that describes the types of this link. The parameters of modules behind a gateway belong to its own ROS node, as
`MODULE.NODE.name`, unless `ros_nodes` shows these nodes themselves. Two parameters are ROS's own, and of every node:
`use_sim_time` and `start_type_description_service`.
"""

import asyncio
import difflib
import functools
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from r2p.clock import SteeredClock
from r2p.codecs.parameters import Name, Plain
from r2p.errors import DecodeError, Error, ParameterError
from r2p.messages import Timestamp
from r2p.parameters.definition import ParameterInfo
from r2p.ros import parameter_messages as messages
from r2p.ros import type_descriptions
from r2p.ros.exposed_parameters import ExposedParameters
from r2p.ros.link import RosLink
from r2p.ros.middleware import Answer, Cancel, Qos, Refuse, RosEndpoint, RosServer, nothing_to_cancel
from r2p.ros.registrations import CALLS, RosClient
from r2p.ros.transport import RosTransport
from r2p.transports.link import Hub

EVENTS = "/parameter_events"
EVENTS_QOS = Qos(depth=1000)

USE_SIM_TIME = "use_sim_time"
_CONSTANT = {
    USE_SIM_TIME: "Whether the node has the time of /clock",
    "start_type_description_service": "Whether the node describes its types",
}
"""The parameters that ROS's libraries give every node."""
_REAL_TIME = "this program has real time: one that calls r2p.sim.run(main, follow=True) has that of /clock"
_NAMES_SHOWN = 8  # in an error
_RUNNING_MAX = 64  # requests of ROS nodes that are worked on at once
_REQUEST_MAX = 1 << 20  # bytes of a request
_NAMES_MAX = 2000  # names in a request; each of them may make an answer of hundreds of bytes
_NAME_MAX = 300  # characters of a name for which a similar one is looked for

Place = tuple[str, Name]
"""A parameter of r2p: its module, and the names of its node and itself."""


class RosParameters:
    """The parameters of one link's ROS nodes."""

    def __init__(self, hub: Hub, link: RosLink) -> None:
        self._link = link
        self._middleware = link.middleware
        self._clock = hub.space.clock
        self._module = hub.space.module
        self._exposed = ExposedParameters(hub, link, self._module_changed)
        self._nodes: dict[str, dict[str, ParameterInfo]] = {}
        """The parameters of each ROS node, by their names there, in order."""
        self._places: dict[str, dict[str, Place]] = {}
        self._being_set: set[tuple[str, str]] = set()
        """Parameters, by node and name, of which an event follows once they are set."""
        self._running: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Offer the parameters until cancelled."""
        try:
            self._link.registrations.watch(self._node_shown, self._node_gone)
            await self._exposed.run()
        finally:
            self._link.registrations.unwatch()
            for task in list(self._running):
                task.cancel()

    # Nodes and what they have

    def _node_shown(self, node: str) -> None:
        """Give a new ROS node its services."""
        for name in messages.SERVICE_NAMES:
            service = f"{node}/{name}"
            self._link.own_servers[service] = functools.partial(self._requested, node, name)
            self._middleware.serve(RosServer(node, service, messages.service(name).kind))
        self._link.own_servers[f"{node}/{type_descriptions.NAME}"] = self._describe_type
        self._middleware.serve(_describer(node))
        self._middleware.advertise(self._events_of(node))
        self._nodes.setdefault(node, {})
        self._refresh(node)

    def _node_gone(self, node: str) -> None:
        for name in messages.SERVICE_NAMES:
            service = f"{node}/{name}"
            del self._link.own_servers[service]
            self._middleware.unserve(RosServer(node, service, messages.service(name).kind))
        del self._link.own_servers[f"{node}/{type_descriptions.NAME}"]
        self._middleware.unserve(_describer(node))
        self._middleware.withdraw(self._events_of(node))
        self._nodes.pop(node, None)

    def _events_of(self, node: str) -> RosEndpoint:
        return RosEndpoint(node, EVENTS, messages.event_type(), EVENTS_QOS)

    def _module_changed(self, _module: str) -> None:
        """Note which parameters there are now."""
        places: dict[str, dict[str, Place]] = {}
        for module, infos in self._exposed.modules.items():
            for name in infos:
                node, own = self._name_in_ros(module, name)
                places.setdefault(node, {})[own] = module, name
        self._places = places
        self._link.registrations.declare("", CALLS, {RosClient(node, "") for node in places})
        for node in self._nodes:
            self._refresh(node)

    def _name_in_ros(self, module: str, name: Name) -> tuple[str, str]:
        """Return the ROS node of a parameter, and its name there."""
        node, own = name
        if module == self._module:
            return self._link.names.node(node), own
        if self._link.options.ros_nodes:
            return self._link.names.node(module, node), own
        return self._link.registrations.module_node, f"{module}.{node}.{own}"

    def _refresh(self, node: str) -> None:
        """Publish what has changed of a node's parameters, unless a request has caused it, which did so itself."""
        before, places = self._nodes[node], self._places.get(node, {})
        now = self._constant(node) | {
            own: self._exposed.modules[module][name] for own, (module, name) in places.items()
        }
        self._nodes[node] = now
        new = {name: info for name, info in now.items() if name not in before}
        changed = {
            name: info
            for name, info in now.items()
            if name in before and before[name].value != info.value and (node, name) not in self._being_set
        }
        deleted = before.keys() - now.keys()
        if new or changed or deleted:
            self._publish(node, new, changed, deleted)

    def _constant(self, node: str) -> dict[str, ParameterInfo]:
        values = {USE_SIM_TIME: isinstance(self._clock, SteeredClock)}
        return {
            name: ParameterInfo(
                module=self._module,
                node=node,
                name=name,
                kind="bool",
                value=values.get(name, True),
                default=False,
                doc=doc,
                read_only=True,
            )
            for name, doc in _CONSTANT.items()
        }

    def _publish(
        self,
        node: str,
        new: Mapping[str, ParameterInfo],
        changed: Mapping[str, ParameterInfo],
        deleted: Any = (),
    ) -> None:
        if not self._link.up:  # what a node has is asked for once the network is there
            return
        now = self._clock.now()
        data = messages.event(node, Timestamp.from_ns(now), new, changed, deleted)
        self._middleware.publish(node, EVENTS, data, now)

    # Requests

    def _requested(self, node: str, name: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        service = messages.service(name)
        try:
            content: Any = _decode(service, request)
        except DecodeError as error:
            self._link.stats.lost["undecodable"] += 1
            refuse(f"the request can't be read: {error}")
            return nothing_to_cancel
        handler = getattr(self, f"_{name}")
        if not name.startswith("set_"):
            answer(service.response.encode(service.response_class(*handler(node, content))))
        elif len(self._running) >= _RUNNING_MAX:
            refuse(f"{_RUNNING_MAX} requests to set parameters are worked on: call again later")
        else:
            task = asyncio.get_running_loop().create_task(self._answer(service, handler(node, content), answer))
            self._running.add(task)
            task.add_done_callback(self._running.discard)
        return nothing_to_cancel  # what is being set can't be stopped half-way

    async def _answer(self, service: messages.ParameterService, made: Any, answer: Answer) -> None:
        answer(service.response.encode(service.response_class(await made)))

    def _describe_type(self, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        try:
            answer(
                type_descriptions.describe(
                    request, (messages.message_class("ParameterEvent"), *self._link.known_types())
                )
            )
        except DecodeError as error:
            self._link.stats.lost["undecodable"] += 1
            refuse(f"the request can't be read: {error}")
        return nothing_to_cancel

    def _find(self, node: str, names: tuple[str, ...]) -> list[ParameterInfo]:
        """Return the parameters; as in ROS, none at all if there is not one of them."""
        known = self._nodes[node]
        return [known[name] for name in names] if all(name in known for name in names) else []

    def _get_parameters(self, node: str, request: Any) -> tuple[Any, ...]:
        return (tuple(map(messages.to_ros, self._find(node, request.names))),)

    def _get_parameter_types(self, node: str, request: Any) -> tuple[Any, ...]:
        return (messages.types_of(self._find(node, request.names)),)

    def _describe_parameters(self, node: str, request: Any) -> tuple[Any, ...]:
        found = self._find(node, request.names)
        return (tuple(messages.descriptor(name, info) for name, info in zip(request.names, found, strict=False)),)

    def _list_parameters(self, node: str, request: Any) -> tuple[Any, ...]:
        found = messages.listed(self._nodes[node], request.prefixes, request.depth)
        return (messages.message_class("ListParametersResult")(*map(tuple, found)),)

    async def _set_parameters(self, node: str, request: Any) -> tuple[Any, ...]:
        """Set each by itself: what one of them can't have says nothing about the others."""
        return tuple([await self._set(node, (each,)) for each in request.parameters])

    async def _set_parameters_atomically(self, node: str, request: Any) -> Any:
        return await self._set(node, request.parameters)

    async def _set(self, node: str, parameters: tuple[Any, ...]) -> Any:
        """Set parameters, all or nothing, and return the result."""
        result = messages.message_class("SetParametersResult")
        try:
            await self._apply(node, parameters)
        except (Error, TimeoutError) as error:
            return result(successful=False, reason=str(error))
        if node in self._nodes:
            given = dict.fromkeys(each.name for each in parameters)
            self._publish(node, {}, {name: self._nodes[node][name] for name in given if name in self._nodes[node]})
        return result(successful=True)

    async def _apply(self, node: str, parameters: tuple[Any, ...]) -> None:
        values: dict[str, dict[Name, Plain]] = {}
        for each in parameters:
            info = self._info(node, each.name)
            try:
                value = messages.from_ros(info, each.value)
                if each.name in _CONSTANT:
                    self._check_constant(info, value)
                    continue
            except ParameterError as error:
                raise ParameterError(f"{each.name}: {error}") from None
            module, name = self._places[node][each.name]
            values.setdefault(module, {})[name] = value
        if len(values) > 1:
            names = " and ".join(sorted(values))
            raise ParameterError(f"these are parameters of several modules, {names}: set those of each together")
        for module, changes in values.items():
            own = {(node, each.name) for each in parameters}
            self._being_set |= own
            try:
                await self._exposed.apply(module, changes)
            finally:
                self._being_set -= own

    def _info(self, node: str, name: str) -> ParameterInfo:
        info = self._nodes.get(node, {}).get(name)
        if info is None:
            own = [each for each in self._nodes.get(node, {}) if each not in _CONSTANT]
            close = difflib.get_close_matches(name, own, n=1) if len(name) <= _NAME_MAX else []
            more = ", ..." if len(own) > _NAMES_SHOWN else ""
            known = f"it has {', '.join(own[:_NAMES_SHOWN])}{more}" if own else "it has none of its own"
            raise ParameterError(
                f"{node} has no parameter {name[:_NAME_MAX]!r}; {f'did you mean {close[0]}?' if close else known}"
            )
        return info

    def _check_constant(self, info: ParameterInfo, value: Plain) -> None:
        """Take the value that it has. Raises ParameterError for another one, which says what to do instead."""
        if value == info.value:
            return
        if info.name != USE_SIM_TIME:
            raise ParameterError("it is read-only")
        if value:
            raise ParameterError(_REAL_TIME)
        raise ParameterError("this program follows /clock, from its start to its end")


def _decode(service: messages.ParameterService, request: bytes) -> Any:
    """Return the content of a request. Raises DecodeError also for one that would keep this program busy for long."""
    if len(request) > _REQUEST_MAX:
        raise DecodeError(f"it has {len(request)} bytes, more than {_REQUEST_MAX}")
    content = service.request.decode(request)
    count = max(len(value) for value in msgspec.structs.astuple(content) if isinstance(value, tuple))
    if count > _NAMES_MAX:
        raise DecodeError(f"it has {count} names, more than {_NAMES_MAX}: ask for some at a time")
    return content


def _describer(node: str) -> RosServer:
    return RosServer(node, f"{node}/{type_descriptions.NAME}", type_descriptions.service())


def _report(link: RosLink, task: "asyncio.Task[None]") -> None:
    error = None if task.cancelled() else task.exception()
    if isinstance(error, Exception):
        link.stats.lost.internal_error(error)


class ParameterTransport(RosTransport):
    """Makes links whose ROS nodes have parameters."""

    async def run_link(self, hub: Hub, link: RosLink, opened: Callable[[], object]) -> None:
        if hub.observer or not link.middleware.has_services:  # a command has no parameters
            await super().run_link(hub, link, opened)
            return
        offering = asyncio.get_running_loop().create_task(RosParameters(hub, link).run())
        offering.add_done_callback(functools.partial(_report, link))
        try:
            await super().run_link(hub, link, opened)
        finally:
            offering.cancel()  # it has nothing to undo: the middleware has ended, with all that it had
