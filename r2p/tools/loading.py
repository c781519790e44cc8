"""Importing the user's files and packages, with errors that tell what to do and tracebacks without our own frames."""

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

import r2p
from r2p.tools.session import Usage


def load_module(where: str) -> ModuleType:
    """The module that `FILE.py` or `package.module` names; imported once, however often it is named.

    A file finds what lies beside it, a package what lies in the working directory, as with `python` itself. Raises
    Usage if there is no such thing, and r2p.Error with the traceback if it can't be executed.
    """
    if where.endswith(".py") or "/" in where:
        return _load_file(where)
    try:
        _look_in(Path.cwd())
    except FileNotFoundError as error:
        raise Usage("the working directory does not exist any more: go to another one") from error
    try:
        return importlib.import_module(where)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{where}.".startswith(f"{error.name}."):
            raise _broken(where, error) from error
        hint = f"did you mean {where}.py?" if Path(f"{where}.py").exists() else "a file's name ends with .py"
        raise Usage(f"there is no module {error.name} here; {hint}") from error
    except Exception as error:
        raise _broken(where, error) from error


def _load_file(where: str) -> ModuleType:
    path = Path(where)
    if path.is_file():
        path = path.resolve()
    else:
        raise Usage(f"there is no file {where}")
    for known in list(sys.modules.values()):
        if getattr(known, "__file__", None) == str(path):
            return known
    name = path.stem if path.stem not in sys.modules else f"_r2p_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise Usage(f"{where} is no Python file: its name has to end with .py")
    module = importlib.util.module_from_spec(spec)
    _look_in(path.parent)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise _broken(where, error) from error
    return module


def _look_in(directory: Path) -> None:
    if str(directory) not in sys.path:
        sys.path.insert(0, str(directory))


def _broken(where: str, error: Exception) -> r2p.Error:
    frame = error.__traceback__
    while frame is not None and _is_ours(frame.tb_frame.f_code.co_filename):
        frame = frame.tb_next
    text = "".join(traceback.format_exception(type(error), error, frame))
    return r2p.Error(f"can't load {where}:\n{text.rstrip()}")


def _is_ours(filename: str) -> bool:
    return filename in {__file__, importlib.__file__} or filename.startswith("<frozen importlib")
