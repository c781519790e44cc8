"""A parameter as its node has it: `Parameter`, what `Node.parameter` returns.

Its value is an attribute, so reading it in a control loop costs nothing more. All that changes it goes through the
registry of its module, which calls `assign` and then `announce`.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self, TypeVar

from r2p.codecs.parameters import Origin, Plain
from r2p.parameters.definition import ParameterDefinition, ParameterInfo
from r2p.parameters.values import plain
from r2p.runtime.queues import EndpointOwner

T = TypeVar("T")


class ParameterOwner(EndpointOwner, Protocol):
    """The node that a parameter belongs to."""

    module: str
    closed: bool


class ParameterSetter(Protocol):
    """What sets a parameter for its program: the registry of the module."""

    def set_own(self, parameter: "Parameter[Any]", value: object) -> None:
        """Set a parameter, checked. Raises ParameterError, and Closed once its node has ended."""


class Parameter(Generic[T]):
    """A parameter of a node. Made by `Node.parameter`.

    `value` is what counts now. It changes when the program calls `set`, and when another module sets or resets it;
    `changes()` and the `on_change` of `Node.parameter` report it.
    """

    if TYPE_CHECKING:  # it is a slot, which costs less to read, and which only the registry writes

        @property
        def value(self) -> T:
            """The value that counts now."""

    else:
        __slots__ = ("_changed", "_on_change", "_registry", "count", "definition", "origin_number", "owner", "value")

    def __init__(
        self,
        registry: ParameterSetter,
        owner: ParameterOwner,
        definition: ParameterDefinition,
        on_change: Callable[[T], object] | None,
    ) -> None:
        self.definition = definition
        self.owner = owner
        self.origin_number = Origin.CODE
        self._registry = registry
        self._on_change = on_change
        self._changed: asyncio.Future[None] | None = None
        self.count = 0
        _write_value(self, definition.default)

    def __setattr__(self, name: str, value: object) -> None:
        if name == "value":
            raise AttributeError(
                f"the value of {self.definition.label} is not an attribute to write: call set({value!r})"
            )
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"<Parameter {self.definition.label} = {plain(self.value)!r}>"

    @property
    def name(self) -> str:
        """The name of the parameter, without its node's."""
        return self.definition.name

    @property
    def origin(self) -> str:
        """Where the value comes from: see `ParameterInfo`."""
        return self.origin_number.text

    def set(self, value: T) -> None:
        """Set the value, as the program itself; a `read_only` parameter, too.

        Raises ParameterError if the value does not fit: then nothing has changed. Raises Closed once the node has
        ended.
        """
        self._registry.set_own(self, value)

    def changes(self) -> AsyncIterator[T]:
        """Iterate over the values that the parameter is set to, from this call on, until its node ends.

        A slow reader gets only the latest value. Setting the value that it has already is not a change.
        """
        return _Changes(self)

    # Called by the registry

    def assign(self, value: Any, origin: Origin) -> bool:
        """Take a value over that was checked; return whether it is another one."""
        different = value != self.value
        _write_value(self, value)
        self.origin_number = origin
        return bool(different)

    def announce(self) -> None:
        """Let the program know that the value has changed. Raises what `on_change` raises in the node's own task; in
        another one, it is the crash of the node.
        """
        self.count += 1
        self.wake()
        if self._on_change is None or self.owner.ending:
            return
        try:
            self._on_change(self.value)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            self.owner.crash(error)

    def wake(self) -> None:
        """Wake those that wait for a change, or for the end of the node."""
        changed, self._changed = self._changed, None
        if changed is not None and not changed.done():
            changed.set_result(None)

    def info(self, module: str, saved: Plain | None, problem: str) -> ParameterInfo:
        """Describe the parameter for others."""
        definition = self.definition
        return ParameterInfo(
            module=module,
            node=self.owner.name,
            name=definition.name,
            kind=definition.kind.text,
            value=plain(self.value),
            default=plain(definition.default),
            minimum=definition.minimum,
            maximum=definition.maximum,
            unit=definition.unit,
            doc=definition.doc,
            read_only=definition.read_only,
            choices=definition.choices,
            origin=self.origin,
            saved=saved,
            problem=problem,
        )

    async def wait(self) -> None:
        """Wait for the next change, or for the end of the node."""
        if self._changed is None:
            self._changed = asyncio.get_running_loop().create_future()
        await asyncio.shield(self._changed)  # several iterators may wait; the end of one is not that of the others


_write_value: Callable[[Parameter[Any], Any], None] = Parameter.__dict__["value"].__set__


class _Changes(Generic[T]):
    """An iterator over the changes of one parameter; it keeps nothing but the number of the last one it has seen."""

    def __init__(self, parameter: Parameter[T]) -> None:
        self._parameter = parameter
        self._seen = parameter.count

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> T:
        parameter = self._parameter
        while self._seen == parameter.count:
            if parameter.owner.closed:
                raise StopAsyncIteration
            await parameter.wait()
        self._seen = parameter.count
        return parameter.value
