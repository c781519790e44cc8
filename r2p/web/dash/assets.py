"""The files of the page, read once from the package."""

from importlib.resources import files
from importlib.resources.abc import Traversable

from r2p.web.server import WebFile

_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def page() -> dict[str, WebFile]:
    """Return the files of the page by path."""
    return dict(_read(files("r2p.web").joinpath("page"), ""))


def _read(folder: Traversable, path: str) -> "list[tuple[str, WebFile]]":
    found: list[tuple[str, WebFile]] = []
    for each in folder.iterdir():
        name = f"{path}/{each.name}"
        suffix = name[name.rfind(".") :]
        if each.is_dir():
            found += _read(each, name)
        elif suffix in _TYPES:
            found.append((name, WebFile(_TYPES[suffix], each.read_bytes())))
    return found
