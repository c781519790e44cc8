"""The parameters of a module for other modules, over r2p's own services (PROTOCOL.md 9).

`ParameterServices` answers. The functions ask; `r2p.modules.graph` offers them as methods of `NetworkView`. What is set
together is sent as one stage, in as many requests as it takes, and then committed: the module checks all of it before
any value counts.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping

import msgspec

from r2p.clock import Clock
from r2p.codecs import parameters as codec
from r2p.codecs.own_services import PAGE_MAX, PAGES_MAX, Operation
from r2p.codecs.parameters import Name, ParameterList
from r2p.errors import DecodeError, Error, MessageError, ParameterError, ServiceError
from r2p.log_lines import get_logger
from r2p.modules.own_services import OwnServices
from r2p.parameters.definition import ParameterInfo, refused
from r2p.parameters.registry import RESET, ModuleParameters
from r2p.parameters.values import outside
from r2p.units import SECOND

logger = get_logger("r2p.module")

STAGES_MAX = 16
"""Stages that a module keeps at once."""
STAGE_MAX = 1 << 16
"""Bytes of a stage."""
STAGE_AGE = 30 * SECOND
"""Ns after which a stage that nothing was added to is forgotten."""

CONTENT_MAX = PAGES_MAX * PAGE_MAX
"""Bytes of the longest list: about a thousand parameters."""

_NUMBERS = 1 << 32  # of stages; 0 asks for a new one
_PART_MAX = PAGE_MAX - len(codec.encode_part(0, 0))


class _StagedSet(msgspec.Struct, eq=False):
    """What was sent of a set so far, and when it came (monotonic ns)."""

    data: bytearray
    touched: int


class ParameterServices:
    """Answers what other modules ask of a module's parameters; counts the changes that it refuses in `refused`."""

    def __init__(
        self,
        parameters: ModuleParameters,
        services: OwnServices,
        clock: Clock,
        numbers: random.Random,
        refused: dict[str, int],
    ) -> None:
        self._parameters = parameters
        self._clock = clock
        self._random = numbers
        self._refused = refused
        self._stages: dict[int, _StagedSet] = {}
        services.serve(Operation.PARAMETERS, self._list)
        services.serve(Operation.PARAMETER_CHANGES, self._list_changes)
        services.serve(Operation.PARAMETER_STAGE, self._stage)
        services.serve(Operation.PARAMETER_COMMIT, self._commit)
        services.serve(Operation.PARAMETER_SAVE, self._save)
        services.serve(Operation.PARAMETER_RESET, self._reset)

    def _list(self, argument: bytes) -> bytes:
        return self._listed(self._parameters.infos(_node(argument)), whole=True)

    def _list_changes(self, argument: bytes) -> bytes:
        revision, parameters = codec.decode_count(argument), self._parameters
        whole = revision < parameters.declared or revision > parameters.revision
        infos = parameters.infos() if whole else parameters.changed_since(revision)
        return self._listed(infos, whole=whole)

    def _listed(self, infos: list[ParameterInfo], *, whole: bool) -> bytes:
        data = codec.encode_list(ParameterList(self._parameters.revision, whole, [*infos]))
        if len(data) > CONTENT_MAX:
            nodes = ", ".join(dict.fromkeys(each.node for each in infos))
            raise ParameterError(f"{len(infos)} parameters are too many for one answer: ask for one node of {nodes}")
        return data

    @contextlib.contextmanager
    def _counts_refusals(self, operation: Operation) -> Iterator[None]:
        try:
            yield
        except Error:
            self._refused[operation.name] = self._refused.get(operation.name, 0) + 1
            raise

    def _stage(self, argument: bytes) -> bytes:
        with self._counts_refusals(Operation.PARAMETER_STAGE):
            return self._add_to_stage(argument)

    def _add_to_stage(self, argument: bytes) -> bytes:
        number, offset, data = codec.decode_part(argument)
        self._forget_old()
        if not number:
            if len(self._stages) >= STAGES_MAX:
                raise ParameterError(f"{len(self._stages)} sets are on their way already: try again later")
            number = self._new_number()
            self._stages[number] = _StagedSet(bytearray(), 0)
        stage = self._find(number)
        if offset != len(stage.data):
            raise ParameterError(f"a part of the set is missing: it has {len(stage.data)} bytes, not {offset}")
        if offset + len(data) > STAGE_MAX:
            del self._stages[number]
            raise ParameterError(f"a set of more than {STAGE_MAX} bytes: set fewer parameters at once")
        stage.data += data
        stage.touched = self._clock.monotonic()
        return codec.encode_count(number)

    def _commit(self, argument: bytes) -> bytes:
        with self._counts_refusals(Operation.PARAMETER_COMMIT):
            return self._commit_stage(argument)

    def _commit_stage(self, argument: bytes) -> bytes:
        number, size, _ = codec.decode_part(argument)
        self._forget_old()
        stage = self._find(number)
        del self._stages[number]
        if size != len(stage.data):
            raise ParameterError(f"a part of the set is missing: it has {len(stage.data)} bytes, not {size}")
        changes = codec.decode_changes(bytes(stage.data))
        self._parameters.apply({name: RESET if value is None else value for name, value in changes.items()})
        return codec.encode_count(self._parameters.revision)

    async def _save(self, _argument: bytes) -> bytes:
        with self._counts_refusals(Operation.PARAMETER_SAVE):
            return codec.encode_count(await self._parameters.save())

    def _reset(self, argument: bytes) -> bytes:
        with self._counts_refusals(Operation.PARAMETER_RESET):
            return codec.encode_count(self._parameters.reset(_node(argument)))

    def _find(self, number: int) -> _StagedSet:
        stage = self._stages.get(number)
        if stage is None:
            raise ParameterError("the module knows nothing of this set any more: set it again")
        return stage

    def _forget_old(self) -> None:
        oldest = self._clock.monotonic() - STAGE_AGE
        self._stages = {number: stage for number, stage in self._stages.items() if stage.touched >= oldest}

    def _new_number(self) -> int:
        while True:
            number = self._random.randrange(1, _NUMBERS)
            if number not in self._stages:
                return number


def _node(argument: bytes) -> str | None:
    return argument.decode(errors="replace") or None


# The asking side

Ask = Callable[[Operation, bytes], Awaitable[bytes]]
"""Asks one module for an operation, with an argument. `NetworkView.ask` says what it raises."""


async def fetch(ask: Ask, module: str, node: str | None) -> list[ParameterInfo]:
    """Return the parameters of a module. Raises ParameterError with the module's text, and Error for other answers."""
    return _infos(module, _decoded(module, await _asked(ask, Operation.PARAMETERS, (node or "").encode())))


async def change(ask: Ask, module: str, values: Mapping[Name, object]) -> None:
    """Set (None: reset) parameters of a module, all or nothing. Raises ParameterError for what it refuses."""
    data = codec.encode_changes({})
    for name, value in values.items():
        try:
            data += codec.encode_changes({name: outside(value)})
        except MessageError as error:
            raise refused(f"{module}/{'.'.join(name)}", value, str(error)) from None
    stage = 0
    for offset in range(0, len(data), _PART_MAX):
        part = codec.encode_part(stage, offset, data[offset : offset + _PART_MAX])
        try:
            stage = await _number_asked(ask, module, Operation.PARAMETER_STAGE, part)
        except TimeoutError as error:
            raise TimeoutError(f"{str(error).partition(';')[0]}: nothing was set") from None
    if stage:
        await _asked(ask, Operation.PARAMETER_COMMIT, codec.encode_part(stage, len(data)))


async def save(ask: Ask, module: str) -> int:
    """Have a module save its parameters. Raises ParameterError with its text."""
    return await _number_asked(ask, module, Operation.PARAMETER_SAVE, b"")


async def reset(ask: Ask, module: str, node: str | None, names: Iterable[str] | None) -> int:
    """Reset parameters of a module; return how many. Raises ParameterError with its text."""
    if names is None:
        return await _number_asked(ask, module, Operation.PARAMETER_RESET, (node or "").encode())
    if node is None:
        raise ParameterError("reset with names= needs their node=, too")
    chosen = dict.fromkeys((node, name) for name in names)
    await change(ask, module, chosen)
    return len(chosen)


async def watch(
    ask: Ask, instance: Callable[[], int | None], module: str, period: float
) -> AsyncIterator[ParameterInfo]:
    """Yield the parameters of a module that change, each as it is then. `follow` says more."""
    before: dict[Name, ParameterInfo] | None = None
    async for known in follow(ask, instance, module, period):
        if before is not None:
            for name, each in known.items():
                if before.get(name) != each:
                    yield each
        before = known


async def follow(
    ask: Ask,
    instance: Callable[[], int | None],
    module: str,
    period: float,
    pause: Callable[[float], Awaitable[object]] = asyncio.sleep,
) -> AsyncIterator[dict[Name, ParameterInfo]]:
    """Yield all parameters of a module, at the beginning and after each change; `instance` is that of the module now.

    Where the module does not answer, it is asked again; one that has restarted is asked for all of its parameters.
    """
    asked = instance()
    listed = _decoded(module, await _asked(ask, Operation.PARAMETERS, b""))
    known = _by_name(module, listed)
    yield known
    silent = False
    while True:
        await pause(period)
        now = instance()
        restarted = now != asked
        operation = Operation.PARAMETERS if restarted else Operation.PARAMETER_CHANGES
        try:
            listed = _decoded(module, await ask(operation, b"" if restarted else codec.encode_count(listed.revision)))
        except (Error, TimeoutError) as error:
            if not silent:
                logger.warning("the parameters of %s can't be watched now: %s; trying again", module, error)
            silent = True
            continue
        silent, asked = False, now
        fresh = _by_name(module, listed)
        fresh = fresh if listed.whole else known | fresh
        if fresh != known:
            known = fresh
            yield known


def _by_name(module: str, listed: ParameterList) -> dict[Name, ParameterInfo]:
    return {(each.node, each.name): each for each in _infos(module, listed)}


async def _asked(ask: Ask, operation: Operation, argument: bytes) -> bytes:
    """Ask, and turn the module's own error into that of a parameter."""
    try:
        return await ask(operation, argument)
    except ServiceError as error:
        raise ParameterError(str(error)) from None


async def _number_asked(ask: Ask, module: str, operation: Operation, argument: bytes) -> int:
    content = await _asked(ask, operation, argument)
    with _readable(module):
        return codec.decode_count(content)


def _decoded(module: str, content: bytes) -> ParameterList:
    with _readable(module):
        return codec.decode_list(content)


@contextlib.contextmanager
def _readable(module: str) -> Iterator[None]:
    try:
        yield
    except DecodeError as error:
        raise Error(f"the answer of {module} is not what this version of r2p can read: {error}") from error


def _infos(module: str, listed: ParameterList) -> list[ParameterInfo]:
    return [ParameterInfo(module=module, **msgspec.structs.asdict(each)) for each in listed.records]
