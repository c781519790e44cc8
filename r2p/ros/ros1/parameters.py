"""r2p parameters on the parameter server of ROS 1: `rosparam get /blink/kp` shows one, `rosparam set` changes it.

The key of a parameter is its ROS node and its name. What a launch file or `rosparam load` has set before counts as set
by a user, when the node comes. A value that r2p refuses is put back, so that the server always has what counts; keys
that were not there before are deleted at the end.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from r2p.codecs.parameters import Name
from r2p.errors import Error
from r2p.ros.exposed_parameters import ExposedParameters
from r2p.ros.graph_names import GraphNames
from r2p.ros.ros1.master import MasterClient, MasterError
from r2p.ros.ros1.names import namespace_of
from r2p.ros.ros1.registration import MasterSession
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError
from r2p.ros.ros1.xmlrpc_codec import Value
from r2p.transports.link import Hub, Link

_NAME: Final = "/r2p_parameters"
"""The caller of what is set: not one of the nodes, or the master would leave out what others need to know."""
_RETRY_S: Final = 0.5  # seconds until a master that did not answer is asked again
_CLOSE_S: Final = 1.0  # seconds for the master to delete keys at the end
_MASTER_ERRORS = (OSError, XmlRpcError)


class _Unset:
    """Stands for the value of a key that is not set."""


_UNSET: Final = _Unset()


class _Mirrored:
    """A parameter and its key on the server."""

    def __init__(self, key: str, module: str, name: Name, value: Value) -> None:
        self.key = key
        self.module = module
        self.name = name
        self.ours = value
        """The value that counts here."""
        self.theirs: Value | _Unset = _UNSET
        """The value on the server, as far as it is known."""
        self.agreed: Value | _Unset = _UNSET
        """The last value that both had."""
        self.is_known = False
        """True once the server has said what it has."""
        self.was_set = False
        """True if the key was there before."""
        self.is_new = True


class ParameterMirror:
    """Keeps the parameters of one link, and those on a ROS 1 parameter server, the same."""

    def __init__(
        self,
        hub: Hub,
        link: Link,
        names: Callable[[str, str], str],
        session: MasterSession,
        given: Mapping[str, object],
    ) -> None:
        """`names` returns the ROS node of a module's node, whose parameters are below it. `given` are first values for
        parameters of this module, by name.
        """
        self._exposed = ExposedParameters(hub, link, self._module_changed)
        self._hub = hub
        self._link = link
        self._node_name = names
        self._session = session
        self._given = given
        self._client = XmlRpcClient()
        self._master = MasterClient(self._client, session.master_uri)
        self._mirrored: dict[str, _Mirrored] = {}
        self._watched: dict[str, set[str]] = {}
        """The keys that are mirrored in each namespace that is subscribed."""
        self._changed: dict[str, None] = {}
        self._wake = asyncio.Event()

    async def run(self) -> None:
        """Mirror until cancelled; then delete the keys that were not there before."""
        following = asyncio.get_running_loop().create_task(self._exposed.run())
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                try:
                    await self._synchronise_all()
                except Exception as error:  # noqa: BLE001 - counted and logged
                    self._link.stats.lost.internal_error(error)
        finally:
            following.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await following
            await self._close()

    # Changes on either side

    def _module_changed(self, module: str) -> None:
        parameters = self._exposed.modules.get(module, {})
        keys = {self._key(module, name): (name, info) for name, info in parameters.items()}
        for key, (name, info) in keys.items():
            value: Value = [*info.value] if isinstance(info.value, tuple) else info.value
            known = self._mirrored.get(key)
            if known is None and (other := self._clash(key)):
                text = (
                    f"{info.full_name} is not on the parameter server: {other} is there, and one can't be in the other"
                )
                self._notice(key, text)
            elif known is None:
                self._mirrored[key] = _Mirrored(key, module, name, value)
                self._watch(key)
            elif known.ours != value or not known.module:
                known.ours, known.module, known.name = value, module, name
                self._mark([key])
        for key in [key for key, each in self._mirrored.items() if each.module == module and key not in keys]:
            self._mark([key])
            self._mirrored[key].module = ""

    def _key(self, module: str, name: Name) -> str:
        """Return the key of a parameter: parts of its name are namespaces."""
        return f"{self._node_name(module, name[0])}/{name[1].replace('.', '/')}"

    def _clash(self, key: str) -> str:
        """Return the key of a parameter that is a namespace of this one, or in it, or an empty text."""
        return next(
            (each for each in self._mirrored if f"{key}/".startswith(f"{each}/") or each.startswith(f"{key}/")), ""
        )

    def _watch(self, key: str) -> None:
        namespace = namespace_of(key)
        self._watched.setdefault(namespace, set()).add(key)
        self._session.watch_parameters(namespace, self._server_changed)

    def _server_changed(self, key: str, value: Value) -> None:
        """Note what the server has now: of a parameter, of one inside of it, or of a namespace."""
        if key in self._watched:
            values = value if isinstance(value, dict) else {}
            for each in self._watched[key]:
                self._set_theirs(each, values.get(each.rpartition("/")[2], _UNSET))
            return
        parameter = next((each for each in (key, namespace_of(key)) if each in self._mirrored), None)
        if parameter is not None:
            self._set_theirs(parameter, _UNSET if value is None or parameter != key else value)

    def _set_theirs(self, key: str, value: Value | _Unset) -> None:
        known = self._mirrored[key]
        if not known.is_known:
            known.is_known = True
            known.was_set = value is not _UNSET
        known.theirs = value
        self._mark([key])

    def _mark(self, keys: Iterable[str]) -> None:
        self._changed.update(dict.fromkeys(keys))
        self._wake.set()

    # Making both the same

    async def _synchronise_all(self) -> None:
        while self._changed:
            key = next(iter(self._changed))
            del self._changed[key]
            try:
                if (each := self._mirrored.get(key)) is not None:
                    await self._synchronise(each)
            except MasterError as error:
                self._notice(key, f"the ROS master refuses the parameter {key}: {error}")
            except _MASTER_ERRORS:  # the session says what is wrong, and what is set when it is back
                self._mark([key])
                self._client.close()
                await asyncio.sleep(_RETRY_S)

    async def _synchronise(self, each: _Mirrored) -> None:
        if each.is_new:
            each.is_new = False
            await self._give(each)
        if not each.module:
            await self._remove(each)
        elif each.is_known and each.theirs != each.ours:
            if not isinstance(each.theirs, _Unset) and each.theirs != each.agreed and await self._accept(each):
                return
            await self._master.set_param(_NAME, each.key, each.ours)
            each.theirs = each.ours
        if each.is_known:
            each.agreed = each.ours

    async def _give(self, each: _Mirrored) -> None:
        """Set a parameter of this module to what the command line has for it."""
        if each.module != self._exposed.own_module or each.name[1] not in self._given:
            return
        try:
            await self._exposed.apply_own(each.module, {each.name: self._given[each.name[1]]})
        except (Error, TimeoutError) as error:
            self._notice(each.key, f"_{each.name[1]}:= of the command line is not used: {error}")
        else:
            each.agreed = each.theirs  # it wins over what is on the server

    async def _accept(self, each: _Mirrored) -> bool:
        """Set the parameter to what the server has; return whether it was accepted."""
        value = each.theirs
        assert not isinstance(value, _Unset)
        try:
            await self._exposed.apply(each.module, {each.name: value})
        except (Error, TimeoutError) as error:
            self._notice(each.key, f"rosparam can't change {each.key}: {error}")
            return False
        each.agreed = value
        return True

    async def _remove(self, each: _Mirrored) -> None:
        namespace = namespace_of(each.key)
        keys = self._watched[namespace]
        keys.discard(each.key)
        if not keys:
            del self._watched[namespace]
            self._session.unwatch_parameters(namespace)
        del self._mirrored[each.key]
        if not each.was_set and each.is_known:
            with contextlib.suppress(MasterError):  # it is deleted already
                await self._master.delete_param(_NAME, each.key)

    def _notice(self, key: str, text: str) -> None:
        self._hub.link_notice(self._link, f"parameter {key}", text, trouble=True)

    async def _close(self) -> None:
        try:
            with contextlib.suppress(*_MASTER_ERRORS):
                async with asyncio.timeout(_CLOSE_S):
                    for each in [*self._mirrored.values()]:
                        await self._remove(each)
        finally:
            self._client.close()


def node_names(names: GraphNames, own_module: str, *, ros_nodes: bool) -> Callable[[str, str], str]:
    """Return what returns the ROS node of a module's node, on a link with these names.

    A node of this module is a ROS node itself. One behind a gateway is so with `ros_nodes`; else its parameters are
    below the gateway's node.
    """

    def name(module: str, node: str) -> str:
        if module == own_module:
            return names.own_node(node, own_module)
        return names.node(module, node) if ros_nodes else names.node(own_module, module, node)

    return name
