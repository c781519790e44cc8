"""The reasons for which the code counts a loss, found in its source: what stands in the brackets of a counter.

A counter is whatever `+=` adds to under a text as the key, or what has one of the names in COUNTERS. Where the key is
not a text itself, it is followed: through constants, conditions, local variables, what functions raise, and the
arguments that callers pass. What cannot be followed is in `unresolved`: it belongs into ELSEWHERE, with the texts that
it stands for.
"""

import ast
from collections.abc import Iterator
from functools import cache
from itertools import product
from pathlib import Path

from r2p.protocols.can_orders import Outcome
from r2p.protocols.keys import Verdict
from r2p.protocols.rtcan.events import Fate
from r2p.transports.can import rawsocket
from tests.docs.blocks import ROOT

COUNTERS = {"lost", "losses", "counts", "dropped", "drops", "faults", "missed", "errors", "self"}
"""Names of counters by reason, without underscores around them; `self` in a class that is a counter."""

_FATES = {fate.value for fate in Fate} - {Fate.SENT.value, Fate.UNKNOWN.value, Fate.DISCARDED.value}  # no losses
_ERROR_FRAMES = {
    *rawsocket._CLASSES.values(),
    *rawsocket._CONTROLLERS.values(),
    *rawsocket._PROTOCOLS.values(),
    "controller",
    "protocol error",
}
ELSEWHERE = {
    ("r2p/protocols/rtcan/transmitter.py", "outcome.value"): {
        Outcome.LOST.value,
        Outcome.ERROR.value,
        Outcome.LATE.value,
    },
    ("r2p/transports/can/socketcan.py", "kind"): _ERROR_FRAMES,
    ("r2p/protocols/rtcan/engine.py", "fate.value"): _FATES | {Fate.DISCARDED.value},
    ("r2p/ros/registrations.py", "f'{self._what}not on ROS'"): {"not on ROS", "service not on ROS"},
    ("r2p/transports/rtcan/tx.py", "done.fate.value"): _FATES,
    ("r2p/transports/guard.py", "verdict.value"): {
        Verdict.NO_KEY.value,
        Verdict.OTHER_KEY.value,
        Verdict.REPEATED.value,
    },
}
"""(File, key): what the key may be."""

_SKIPPED = ("sim", "tools", "recording", "monitoring", "web")
"""What is emulated has losses of its own; tools, pages and viewers count only for their output; recordings and monitors
by topic: see there.
"""

Function = ast.FunctionDef | ast.AsyncFunctionDef


class _File:
    """One file of the code, and for each of its expressions the function around it."""

    def __init__(self, path: Path) -> None:
        self.name = str(path.relative_to(ROOT))
        self.tree = ast.parse(path.read_text(encoding="utf-8"))
        self.nodes = list(ast.walk(self.tree))
        self.around: dict[ast.AST, Function] = {}
        for function in self.nodes:  # those inside come later, and win
            if isinstance(function, Function):
                self.around.update(dict.fromkeys(ast.walk(function), function))
        self.calls: dict[str, list[ast.Call]] = {}
        """By the last part of the name that is called."""
        for node in self.nodes:
            match node:
                case ast.Call(func=ast.Attribute(attr=name) | ast.Name(id=name)):
                    self.calls.setdefault(name, []).append(node)
        self.constants = {
            target.id: node.value
            for node in self.tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }


@cache
def _files() -> list[_File]:
    package = ROOT / "r2p"
    paths = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in _SKIPPED]
    return [_File(path) for path in sorted(paths)]


class Reasons:
    """`found` by the reasons, with the files that count them; `unresolved` are (file, key) that nothing explains."""

    def __init__(self) -> None:
        self.found: dict[str, set[str]] = {}
        self.unresolved: set[tuple[str, str]] = set()
        for file in _files():
            for key in _keys(file):
                for reason in self._texts(file, key, ()):
                    self.found.setdefault(reason, set()).add(file.name)

    def _texts(self, file: _File, key: ast.expr, path: tuple[ast.AST, ...]) -> set[str]:
        """What the expression may be. `path`: what is being followed, so that recursion ends."""
        known = ELSEWHERE.get((file.name, ast.unparse(key)))
        if known is not None:
            return known
        match key:
            case ast.Constant(value=str(text)):
                return {text}
            case ast.IfExp(body=one, orelse=other):
                return self._texts(file, one, path) | self._texts(file, other, path)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                pairs = product(self._texts(file, left, path), self._texts(file, right, path))
                return {one + other for one, other in pairs}
            case ast.Name(id=name):
                return self._variable(file, key, name, path)
            case ast.Call(func=ast.Name(id="str"), args=[ast.Name() as error]):
                return self._raised(file, error, path)
        self.unresolved.add((file.name, ast.unparse(key)))
        return set()

    def _variable(self, file: _File, key: ast.expr, name: str, path: tuple[ast.AST, ...]) -> set[str]:
        function = file.around.get(key)
        if function in path:
            return set()
        if function is not None and (place := _place(function, name)) is not None:
            texts = [self._texts(one, each, (*path, function)) for one, each in _passed(file, function, name, place)]
        else:
            values = _assigned(function, name) if function is not None else []
            constants = [(each, each.constants[name]) for each in _files() if name in each.constants]
            texts = [self._texts(one, each, path) for one, each in ([(file, each) for each in values] or constants)]
        if not texts:
            self.unresolved.add((file.name, name))
        return set().union(*texts)

    def _raised(self, file: _File, error: ast.Name, path: tuple[ast.AST, ...]) -> set[str]:
        """The texts of the exceptions that are caught as this name."""
        kinds = {
            ast.unparse(node.type)
            for node in ast.walk(file.around[error])
            if isinstance(node, ast.ExceptHandler) and node.name == error.id and node.type is not None
        }
        raised = [
            node.exc.args[0]
            for node in file.nodes
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and ast.unparse(node.exc.func) in kinds
        ]
        return set().union(*(self._texts(file, each, path) for each in raised))


def _keys(file: _File) -> Iterator[ast.expr]:
    """What the counters of a file count by."""
    for node in file.nodes:
        match node:
            case ast.AugAssign(target=ast.Subscript(value=counter, slice=key), op=ast.Add()):
                if _is_counter(counter) or _is_text(key):
                    yield key
            case ast.Assign(targets=[ast.Subscript(value=counter, slice=key)], value=ast.BinOp()) if _is_counter(
                counter
            ):
                yield key
            case ast.Call(func=ast.Name(id="Counter"), args=[ast.Dict(keys=keys)]):
                yield from filter(None, keys)


def _is_text(key: ast.expr) -> bool:
    """Whether it is a text, or a constant with one."""
    match key:
        case ast.Constant(value=str()):
            return True
        case ast.Name(id=name):
            return name.isupper()
    return False


def _is_counter(node: ast.expr) -> bool:
    return ast.unparse(node).rpartition(".")[2].strip("_") in COUNTERS


def _place(function: Function, name: str) -> int | None:
    """Which parameter it is."""
    names = [each.arg for each in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return names.index(name) if name in names else None


def _passed(file: _File, function: Function, name: str, place: int) -> Iterator[tuple[_File, ast.expr]]:
    """What callers pass for that parameter. A private function is called in its own file only; a public one may be kept
    in a private attribute, and be called from there.
    """
    names = (function.name, f"_{function.name}")
    method = bool(function.args.args) and function.args.args[0].arg == "self"
    for each in [file] if function.name.startswith("_") else _files():
        for node in (call for called in names for call in each.calls.get(called, ())):
            if place - method < len(node.args):
                yield each, node.args[place - method]
            yield from ((each, keyword.value) for keyword in node.keywords if keyword.arg == name)


def _assigned(function: Function, name: str) -> list[ast.expr]:
    """What a local variable is set to."""
    return [
        node.value
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and any(isinstance(each, ast.Name) and each.id == name for each in node.targets)
    ]
