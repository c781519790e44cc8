"""Load the functions of nodes at run time: from files of one directory, or from code that another module has sent.

A file is compiled anew each time. The modules that it imports from the directory are loaded again if they, or what they
import from there, have changed; other modules of the program stay as they are. If anything fails, `sys.modules` is as
before, and what runs goes on with the code that it has.
"""

import ast
import asyncio
import contextlib
import importlib
import importlib.util
import inspect
import linecache
import os
import stat
import sys
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path

from r2p.clock import clock_of
from r2p.errors import Error, InvalidName
from r2p.log_lines import internal, short_traceback
from r2p.modules.supervisor import NodeFunction, name_of

CODE_MAX = 256 << 10
"""Bytes of the longest file."""

_TIMEOUT = 30.0  # seconds that the code of a file may run while it is loaded
_PREFIX = "_r2p_"  # of the names of modules whose own name has another one already
_SENT = f"{_PREFIX}sent_"  # ... and of those that were sent

_INSTALLED = frozenset({"site-packages", "dist-packages"})

_Signature = tuple[int, int]


class CodeLoader:
    """Loads functions from the files of one directory, and from code that was sent."""

    def __init__(self, directory: Path) -> None:
        """Use this directory. Raises Error for a missing one, and for one that other users can write."""
        self.directory = directory.resolve()
        if not self.directory.is_dir():
            raise Error(f"allow_load: there is no directory {directory}")
        _check_owner(self.directory, self.directory.stat())
        self._known = {name: _signature(path) for name, path in self._own_modules()}
        """The state of the files of loaded modules, when they were loaded."""
        self._loading = asyncio.Lock()

    async def load(self, file: str, function: str) -> NodeFunction:
        """Return a function of a file, whose path is relative to the directory, or absolute.

        Raises Error for a path that does not lead to a file in the directory, and with the traceback of what is wrong
        in the file.
        """
        path = self._path(file)
        source = _read(path)
        _check_owner(path.parent, path.parent.stat())  # it is imported from
        return await self._load(file, function, lambda: self._run_file(path, source))

    async def load_sent(self, name: str, code: bytes, function: str) -> NodeFunction:
        """Return a function of code that was sent, as a file of this name in the directory. Raises Error.

        It is kept in memory only.
        """
        return await self._load(name, function, lambda: self._run_sent(name, code))

    def _path(self, file: str) -> Path:
        try:
            path = (self.directory / file).resolve()
            found = path.is_file()
        except (OSError, ValueError, RuntimeError):  # a loop of links, a null byte
            raise Error(f"{file!r} is not a path") from None
        if not path.is_relative_to(self.directory):
            raise Error(f"{file} is not in {self.directory}, and no other code may be loaded (--load-dir)")
        if not found:
            raise Error(f"there is no file {file} in {self.directory}, on the computer of the module")
        if path.suffix != ".py":
            raise Error(f"{file} is not a Python file: its name must end with .py")
        return path

    async def _load(self, file: str, function: str, run: Callable[[], types.ModuleType]) -> NodeFunction:
        """Run code, in a thread, as imports may take long, and return a function of its module."""
        async with self._loading:
            before = dict(self._own_modules()), dict(sys.modules)
            try:
                module = await _in_thread(run)
                found = _function(file, module, function)
            except BaseException as error:  # SystemExit as well: the user's code may raise anything
                self._undo(*before)
                if isinstance(error, Error | asyncio.CancelledError | KeyboardInterrupt):
                    raise
                raise Error(f"can't load {file}:\n{_traceback(error)}") from None
        self._known = {name: _signature(path) for name, path in self._own_modules()}
        return found

    def _run_file(self, path: Path, source: bytes) -> types.ModuleType:
        self._prepare(path.parent)
        # A file named json.py must not replace the module that others have imported.
        known = sys.modules.get(path.stem)
        own = known is None or getattr(known, "__file__", None) == str(path)
        name = path.stem if own else f"{_PREFIX}{path.stem}"
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        return _run(importlib.util.module_from_spec(spec), source, str(path))

    def _run_sent(self, name: str, code: bytes) -> types.ModuleType:
        self._prepare(self.directory)
        filename = f"<sent {name}>"
        lines = code.decode(errors="replace").splitlines(keepends=True)
        linecache.cache[filename] = len(code), None, lines, filename  # tracebacks quote it
        stem = "".join(each if each.isalnum() else "_" for each in name.removesuffix(".py"))
        module = types.ModuleType(f"{_SENT}{stem}")
        module.__file__ = filename
        return _run(module, code, filename)

    def _prepare(self, directory: Path) -> None:
        """Let code that is loaded next import what is in a directory, as it is now."""
        self._forget_changed()
        if str(directory) not in sys.path:
            sys.path.insert(0, str(directory))

    def _forget_changed(self) -> None:
        """Forget the modules of the directory whose files have changed, and those that import them."""
        own = dict(self._own_modules())
        changed = {name for name, path in own.items() if self._known.get(name) != _signature(path)}
        imports = {name: _imported(path, _package(name)) for name, path in own.items()} if changed else {}
        while more := {name for name in own.keys() - changed if imports and imports[name] & changed}:
            changed |= more
        for name in changed:
            cached = getattr(sys.modules.pop(name).__spec__, "cached", None)
            if cached:  # Python compares times in seconds: a second change in one would not be seen
                with contextlib.suppress(OSError):
                    Path(cached).unlink(missing_ok=True)
        importlib.invalidate_caches()

    def _undo(self, own: dict[str, Path], modules: dict[str, types.ModuleType]) -> None:
        """Put back the modules of the directory as they were. Others that were imported stay: they may be in use."""
        for name in dict(self._own_modules()):
            if name not in own:
                del sys.modules[name]
        sys.modules.update({name: modules[name] for name in own})

    def _own_modules(self) -> Iterator[tuple[str, Path]]:
        """Return the names of all loaded modules whose files are in the directory, with these."""
        for name, module in list(sys.modules.items()):
            file = getattr(module, "__file__", None)
            if name == "__main__" or not isinstance(file, str) or _is_installed(file):
                continue
            if Path(file).is_relative_to(self.directory) or name.startswith(_SENT):
                yield name, Path(file)


def _is_installed(file: str) -> bool:
    """Return whether a file is of r2p, of Python, or of an installed package: a virtual environment may be anywhere."""
    return internal(file) or not _INSTALLED.isdisjoint(Path(file).parts) or file.startswith(sys.prefix + os.sep)


def _package(name: str) -> str:
    """Return the package to which the relative imports of a loaded module refer."""
    return str(getattr(sys.modules[name], "__package__", None) or "")


def _imported(path: Path, package: str) -> set[str]:
    """Return the names of all modules that a file imports, those of their packages, and what may be a module in one."""
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError):  # it is not the one that was loaded; it counts as changed
        return set()
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            with contextlib.suppress(ImportError):  # beyond the top of its package
                base = importlib.util.resolve_name(base, package)
            names.add(base)
            names.update(f"{base}.{each.name}" for each in node.names)
    return {name.rsplit(".", count)[0] for name in names for count in range(name.count(".") + 1)}


def _signature(path: Path) -> _Signature | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _check_owner(path: Path, status: os.stat_result) -> None:
    """Raise Error for a file, or a directory, of another user than this one and root, or that everyone can write."""
    if os.name != "posix":
        return
    if status.st_uid not in {0, os.geteuid()} or status.st_mode & stat.S_IWOTH:
        do = "use another directory (--load-dir)" if stat.S_ISDIR(status.st_mode) else "chown it, and chmod o-w"
        raise Error(f"{path} belongs to another user, or everyone can write it: {do}")


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            _check_owner(path, os.fstat(file.fileno()))  # of this file: the path may lead to another one now
            source = file.read(CODE_MAX + 1)
    except OSError as error:
        raise Error(f"can't read {path}: {error.strerror}") from None
    if len(source) > CODE_MAX:
        raise Error(f"{path} has more than {CODE_MAX >> 10} KiB: import its larger parts from other files")
    return source


def _run(module: types.ModuleType, source: bytes, filename: str) -> types.ModuleType:
    code = compile(source, filename, "exec", dont_inherit=True)
    sys.modules[module.__name__] = module  # before it runs, as `import` does: its dataclasses look it up
    exec(code, module.__dict__)  # noqa: S102 - what this file is for: see docs/security.md
    linecache.checkcache(filename)
    return module


def _traceback(error: BaseException) -> str:
    """Format an error of the user's code from its first frame on: a wrong syntax has none."""
    trace = error.__traceback__
    while trace is not None and internal(trace.tb_frame.f_code.co_filename):
        trace = trace.tb_next
    return short_traceback(error.with_traceback(trace))


def _function(file: str, module: types.ModuleType, name: str) -> NodeFunction:
    function: NodeFunction | None = getattr(module, name, None)
    if function is None:
        names = ", ".join(
            each
            for each, value in vars(module).items()
            if getattr(value, "__module__", None) == module.__name__ and inspect.iscoroutinefunction(value)
        )
        raise Error(f"{file} has no function {name}; {f'it has {names}' if names else 'it defines no node'}")
    with contextlib.suppress(InvalidName):  # the node may have another name
        name_of(function)
    return function


async def _in_thread(run: Callable[[], types.ModuleType]) -> types.ModuleType:
    """Run code in a thread of its own, which does not keep the process going; under virtual time, here.

    Raises Error if it takes too long.
    """
    loop = asyncio.get_running_loop()
    if clock_of(loop).virtual:
        return run()
    # With errors as results: a future does not take a StopIteration, and complains about one that is not awaited.
    result: asyncio.Future[types.ModuleType | Exception] = loop.create_future()

    def finish(outcome: types.ModuleType | Exception) -> None:
        if not result.done():
            result.set_result(outcome)

    def work() -> None:
        outcome: types.ModuleType | Exception
        try:
            outcome = run()
        except Exception as raised:  # noqa: BLE001 - the user's code: it is raised again where it is awaited
            outcome = raised
        except BaseException as raised:  # noqa: BLE001 - SystemExit and the like would end the program there
            outcome = Error(f"it raises {type(raised).__name__}: {raised}")
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(finish, outcome)

    threading.Thread(target=work, name="r2p-load", daemon=True).start()
    await asyncio.wait([result], timeout=_TIMEOUT)
    if not result.done():
        result.cancel()
        raise Error(
            f"the file still runs {_TIMEOUT:g} s after its start: what it does has to be in the node's function"
        )
    outcome = result.result()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome
