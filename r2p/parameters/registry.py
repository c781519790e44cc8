"""The parameters of one module: what its nodes have declared, and every change of it.

A change is checked as a whole before anything of it counts: `set`, `reset` and what other modules send all end in
`apply`. Values that were set at run time outlive the nodes, so that a node which crashed starts with them again.
"""

import asyncio
import difflib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Final, TypeVar, cast

from r2p.codecs.parameters import Name, Origin, Plain
from r2p.errors import Closed, ParameterError
from r2p.parameters.definition import ParameterDefinition, ParameterInfo
from r2p.parameters.file import ParameterFile
from r2p.parameters.parameter import Parameter, ParameterOwner
from r2p.parameters.sources import GivenValueError, ParameterSource
from r2p.parameters.values import plain

T = TypeVar("T")


class _Reset:
    """Stands for a value that is to be that of the start again."""


RESET: Final = _Reset()

_Value = tuple[Any, Origin]


class ModuleParameters(Mapping[Name, Parameter[Any]]):
    """The parameters of a module's nodes, by (node, name), in the order of their declaration: `Module.parameters`."""

    def __init__(self, module: str, sources: Iterable[ParameterSource] = (), file: ParameterFile | None = None) -> None:
        self.revision = 0
        """Grows with each change of a value or of the file."""
        self.declared = 0
        """The revision at which a parameter was declared or went last."""
        self._module = module
        self._sources = list(sources)  # the strongest first
        self._file = file
        self._parameters: dict[Name, Parameter[Any]] = {}
        self._changed_at: dict[Name, int] = {}
        self._replaced: dict[Name, Parameter[Any]] = {}
        """Those of a node that goes on if the one that is to replace it fails, whose parameters count meanwhile."""
        self._run_time: dict[Name, tuple[Plain, Origin]] = {}
        self._saved: dict[Name, object] = {}
        self._problems: dict[Name, str] = {}
        """Why a saved value is not used."""
        self._unsaved: set[Name] = set()
        """Parameters that were reset, whose saved value does not count until it is saved again."""
        self._saving = asyncio.Lock()

    def __getitem__(self, name: Name) -> Parameter[Any]:
        return self._parameters[name]

    def __iter__(self) -> Iterator[Name]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    # The life of the module and its nodes

    async def load(self) -> None:
        """Read the saved file, if the module has one. Raises ParameterError for one that can't be read."""
        if self._file is not None:
            async with self._saving:  # or what is saved meanwhile would count as unsaved
                self._saved = await self._file.load(self._module)
            self._touch(self._parameters)

    def forget_run_time(self) -> None:
        """Forget what was set at run time: the module reboots."""
        self._run_time.clear()
        self._unsaved.clear()

    def declare(
        self, owner: ParameterOwner, definition: ParameterDefinition, on_change: Callable[[T], object] | None
    ) -> Parameter[T]:
        """Add a parameter, with the value that counts for it.

        Raises ParameterError if the node has it already, and for a value of an option that does not fit.
        """
        if on_change is not None and inspect.iscoroutinefunction(on_change):
            text = "on_change is called, not awaited: pass a plain function, or iterate changes()"
            raise ParameterError(f"parameter {definition.label}: {text}")
        name = owner.name, definition.name
        known = self._parameters.get(name)
        if known is not None and known.owner is owner:
            raise ParameterError(f"parameter {definition.label} is declared twice: keep what the first call returned")
        value, origin = self._first_value(owner, name, definition)
        parameter: Parameter[T] = Parameter(self, owner, definition, on_change)
        parameter.assign(value, origin)
        self._parameters[name] = parameter
        if known is not None and not known.owner.closed:
            self._replaced[name] = known
        self._touch([name])
        self.declared = self.revision
        return parameter

    def node_closed(self, owner: ParameterOwner) -> None:
        """End the iterators over changes: the node has ended, and may start again."""
        for parameter in (*self._of(owner.name), *self._replaced.values()):
            if parameter.owner is owner:
                parameter.wake()

    def node_gone(self, node: str) -> None:
        """Drop the parameters of a node that has ended for good."""
        gone = [(node, each.name) for each in self._of(node) if each.owner.closed]
        for name in gone:
            del self._parameters[name]
            self._changed_at.pop(name, None)
        for name in [name for name in self._replaced if name[0] == node]:
            before = self._replaced.pop(name)
            if not before.owner.closed:  # the node goes on
                self._give_back(name, before)
        if gone:
            self._touch(())
            self.declared = self.revision

    def _give_back(self, name: Name, before: Parameter[Any]) -> None:
        """Let the parameter of a node that goes on count again, with what was set meanwhile if that fits."""
        self._parameters[name] = before
        self._touch([name])
        value, origin = self._run_time.get(name, (before.value, before.origin_number))
        try:
            self._commit({name: (before.definition.convert(value), origin)})
        except ParameterError:
            del self._run_time[name]

    def unused(self) -> list[str]:
        """Return what options and files name that no node has declared, each with its source."""
        return [f"{key} ({source.label})" for source in self._sources for key in source.unused()]

    def similar(self, unused: str) -> str:
        """Return the end of a message about a text of `unused`: the parameter with the most similar name, if any."""
        known = [text for node, name in self._parameters for text in (f"{node}.{name}", name)]
        close = difflib.get_close_matches(unused.partition(" ")[0], known, n=1)
        return f"; did you mean {close[0]}?" if close else ""

    # Reading

    def infos(self, node: str | None = None) -> list[ParameterInfo]:
        """Describe the parameters, of one node or of all. Raises ParameterError for an unknown node."""
        names = [name for name in self._parameters if node in (None, name[0])]
        if node is not None and not names:
            raise self._unknown_node(node)
        return [self._info(name) for name in names]

    def changed_since(self, revision: int) -> list[ParameterInfo]:
        """Describe the parameters that have changed after this revision."""
        return [self._info(name) for name, changed in self._changed_at.items() if changed > revision]

    def _info(self, name: Name) -> ParameterInfo:
        parameter = self._parameters[name]
        saved, problem = None, self._problems.get(name, "")
        if not problem and name in self._saved:
            try:
                saved = plain(parameter.definition.convert(self._saved[name]))
            except ParameterError as error:  # it came with the last save, from whoever edited the file
                problem = _misfit(error)
        return parameter.info(self._module, saved, problem)

    # Changing

    def set(self, values: Mapping[Name, object]) -> None:
        """Set one or several parameters, all or nothing: those that are given by (node, name).

        Raises ParameterError, which names the first that does not fit: then nothing has changed. Raises what an
        `on_change` of the calling node raises, when all values are set.
        """
        self.apply(values)

    def reset(self, node: str | None = None, names: Iterable[str] | None = None) -> int:
        """Undo what was set and what was saved: of all nodes or one, of all its parameters or some. Return how many.

        The values are those of the start without a saved file. The file itself changes with the next `save`. Parameters
        that are `read_only` stay; to name one is an error. Raises ParameterError: then nothing has changed.
        """
        if names is not None and node is None:
            raise ParameterError("reset with names= needs their node=, too")
        if node is not None and not self._of(node):
            raise self._unknown_node(node)
        if node is not None and names is not None:
            chosen = [(node, each) for each in names]
        else:
            chosen = [
                name
                for name, each in self._parameters.items()
                if node in (None, name[0]) and not each.definition.read_only
            ]
        self.apply(dict.fromkeys(chosen, RESET))
        return len(chosen)

    def apply(self, changes: Mapping[Name, object], origin: Origin = Origin.RUN_TIME) -> None:
        """Set and reset (RESET) parameters, all or nothing: `set` says what it raises."""
        staged: dict[Name, _Value] = {}
        for name, value in changes.items():
            parameter = self._find(name)
            if parameter.definition.read_only and origin is not Origin.PROGRAM:
                raise ParameterError(f"{parameter.definition.label} is read-only: only its own node sets it")
            if value is RESET:
                staged[name] = self._start_value(name, parameter.definition, saved=False)
            else:
                staged[name] = parameter.definition.convert(value), origin
        self._verify(staged)
        for name, value in changes.items():
            self._keep(name, None if value is RESET else staged[name])
        self._commit(staged)

    def set_own(self, parameter: Parameter[Any], value: object) -> None:
        """Set a parameter for its own node. Raises ParameterError, and Closed once the node has ended."""
        name = parameter.owner.name, parameter.name
        if parameter.owner.closed:
            raise Closed(f"node {parameter.owner.name} has ended: it can't set {parameter.name} any more")
        if self._parameters.get(name) is not parameter:  # another node of this name has taken it over
            raise Closed(f"parameter {parameter.definition.label} belongs to a newer node of this name")
        self.apply({name: value}, Origin.PROGRAM)

    async def save(self) -> int:
        """Write what was set at run time to the module's file, and remove what was reset; return how many it has.

        Raises ParameterError if the module has no file, or if it can't be written: then it has its old contents.
        """
        if self._file is None:
            raise ParameterError(
                f"{self._module} has no file for parameters: start it with `r2p run --params-file FILE`, `params_file` "
                "in r2p.toml, or Module(params_file=)"
            )
        async with self._saving:
            changes: dict[Name, Plain | None] = dict.fromkeys(self._unsaved)
            changes.update((name, value) for name, (value, _) in self._run_time.items())
            self._saved = await self._file.save(self._module, changes)
        for name in changes:
            self._problems.pop(name, None)
            if changes[name] is None:
                self._unsaved.discard(name)
        self._touch(self._parameters)
        return len(self._saved)

    def _find(self, name: Name) -> Parameter[Any]:
        parameter = self._parameters.get(name)
        if parameter is not None:
            return parameter
        node, own = name
        names = [each.name for each in self._of(node)]
        if not names:
            raise self._unknown_node(node)
        close = difflib.get_close_matches(own, names, n=1)
        hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(names)}"
        raise ParameterError(f"{self._module}/{node} has no parameter {own}; {hint}")

    def _unknown_node(self, node: str) -> ParameterError:
        nodes = ", ".join(dict.fromkeys(name[0] for name in self._parameters))
        known = f"nodes with parameters are {nodes}" if nodes else "none of its nodes has any now"
        return ParameterError(f"{self._module} has no node {node} with parameters; {known}")

    def _verify(self, staged: Mapping[Name, _Value]) -> None:
        """Ask the checks of what is set, and those that see all values of a node."""
        for node in dict.fromkeys(name[0] for name in staged):
            parameters = self._of(node)
            values = {each.name: staged.get((node, each.name), (each.value,))[0] for each in parameters}
            for each in parameters:
                if (node, each.name) in staged or each.definition.check_sees_all:
                    each.definition.verify(values[each.name], values)

    def _keep(self, name: Name, value: _Value | None) -> None:
        """Note what a parameter is set to, for the next start of its node; None: it was reset."""
        if value is None:
            self._run_time.pop(name, None)
            self._unsaved.add(name)
        else:
            self._run_time[name] = plain(value[0]), value[1]
            self._unsaved.discard(name)

    def _commit(self, staged: Mapping[Name, _Value]) -> None:
        assigned = [(self._parameters[name], value) for name, value in staged.items()]
        changed = [parameter for parameter, value in assigned if parameter.assign(*value)]
        self._touch(staged)
        errors: list[Exception] = []
        for parameter in changed:
            try:
                parameter.announce()
            except Exception as error:  # noqa: BLE001 - of the calling node; the others learn of their values first
                errors.append(error)
        if errors:
            raise errors[0]

    def _touch(self, names: Iterable[Name]) -> None:
        self.revision += 1
        self._changed_at.update(dict.fromkeys(names, self.revision))

    def _of(self, node: str) -> list[Parameter[Any]]:
        return [each for name, each in self._parameters.items() if name[0] == node]

    # Values at the start

    def _first_value(self, owner: ParameterOwner, name: Name, definition: ParameterDefinition) -> _Value:
        """Return the value of a parameter that is declared now; what was set before its node crashed comes first."""
        own = [each for each in self._of(owner.name) if each.owner is owner]
        defaults = {each.name: each.definition.default for each in own}
        definition.verify(definition.default, defaults | {definition.name: definition.default})
        others = {each.name: each.value for each in own}
        kept = self._run_time.get(name)
        if kept is not None:
            try:
                return self._verified(definition, others, definition.convert(kept[0]), kept[1])
            except ParameterError as error:
                del self._run_time[name]
                owner.log.warning("a value of before does not fit any more and is forgotten: %s", error)
        self._check_saved(owner, name, definition, others)
        value, origin = self._start_value(name, definition, saved=name not in self._unsaved)
        try:
            return self._verified(definition, others, value, origin)
        except ParameterError as error:
            if origin > Origin.SAVED:
                raise
            owner.log.warning("it does not go together with the first values of other parameters: %s", error)
            return value, origin

    def _verified(
        self, definition: ParameterDefinition, others: Mapping[str, Any], value: Any, origin: Origin
    ) -> _Value:
        definition.verify(value, {**others, definition.name: value})
        return value, origin

    def _check_saved(
        self, owner: ParameterOwner, name: Name, definition: ParameterDefinition, others: Mapping[str, Any]
    ) -> None:
        """Report a saved value that does not fit; it stays in the file, and is not used."""
        self._problems.pop(name, None)
        if name not in self._saved:
            return
        try:
            self._verified(definition, others, definition.convert(self._saved[name]), Origin.SAVED)
        except ParameterError as error:
            self._problems[name] = _misfit(error)
            owner.log.warning("the saved value does not fit and is not used (it stays in the file): %s", error)

    def _start_value(self, name: Name, definition: ParameterDefinition, *, saved: bool) -> _Value:
        """Return the value without what was set at run time. Raises ParameterError for an option that does not fit."""
        for source in self._sources:
            key = source.find(name)
            if key is not None:
                return self._of_source(source, key, definition), source.origin
        if saved and name in self._saved and name not in self._problems:
            return definition.convert(self._saved[name]), Origin.SAVED
        return definition.default, Origin.CODE

    def _of_source(self, source: ParameterSource, key: Name | str, definition: ParameterDefinition) -> Any:
        value = source.values[key]
        try:
            return definition.parse(cast("str", value)) if source.texts else definition.convert(value)
        except ParameterError as error:
            raise GivenValueError(f"{error} (from {source.label})") from None


def _misfit(error: ParameterError) -> str:
    return f"the saved value does not fit: {error}"
