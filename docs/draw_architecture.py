"""Draws `assets/architecture.svg`: the packages of r2p in their layers, with their files, read from the code itself.

Run it from the root of the project when files were added, moved or removed: `python docs/draw_architecture.py`. It
refuses to draw a package that is in no layer, and an import that leads upwards. A test compares picture and code.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from xml.sax.saxutils import escape

import grimp

PICTURE = Path(__file__).parent / "assets" / "architecture.svg"

LAYERS: dict[str, tuple[str, ...]] = {
    "Commands, test tools": ("tools", "testing"),
    "Web pages, Foxglove": ("web", "web.dash", "web.foxglove"),
    "Recordings": ("recording",),
    "Monitoring": ("monitoring",),
    "Simulation, boot loader, ROS": (
        "sim",
        "sim.can",
        "sim.buses",
        "sim.modules",
        "sim.physics",
        "sim.robots",
        "loader",
        "ros",
        "ros.ros1",
        "ros.ros2",
        "ros.dds",
    ),
    "Modules": ("modules", "bus"),
    "Gateways": ("bridge",),
    "Links": ("transports", "transports.can", "transports.rtcan", "transports.zenoh"),
    "Nodes and topics": ("runtime", "runtime.publishers", "services", "parameters"),
    "Protocols and analysis, pure": (
        "analysis",
        "protocols",
        "protocols.discovery",
        "protocols.liveliness",
        "protocols.rtcan",
        "protocols.bridge",
    ),
    "Bytes": ("codecs", "messages", "msg"),
    "Basics": ("names", "clock", "log_lines", "keys", "units", "errors", "startup", "version"),
}
"""What each layer is called in the picture, and its packages; a layer imports only from itself and from those below."""

_WIDTH, _MARGIN, _LABEL, _GAP = 1000, 12, 112, 8  # px
_LINE, _HEAD, _CHARACTER = 16, 28, 6.6  # px: a line of file names, the name of a box, a character of either
_STYLE = """
    .layer { fill: #76808e; fill-opacity: .08 }
    .label { fill: #5f6977; font-size: 13px; font-weight: 600 }
    .box { fill: #4338ca; fill-opacity: .1; stroke: #4338ca; stroke-width: 1.2 }
    .name { fill: #4338ca; font-size: 13px; font-weight: 600 }
    .files { fill: #5f6977; font-size: 12px }
    @media (prefers-color-scheme: dark) {
      .box { fill: #a5b4fc; stroke: #a5b4fc }
      .name { fill: #a5b4fc }
      .label, .files { fill: #a5afbd }
    }"""

_HEADER = f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} %d" role="img" \
aria-labelledby="title desc" font-family="system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif">
  <title id="title">The packages of r2p in their layers</title>
  <desc id="desc">Each row is a layer and imports only from those below it. Boxes are packages with their files.</desc>
  <style>{_STYLE}
  </style>"""


class DrawingError(Exception):
    """The code has something for which the picture has no place."""


def draw() -> str:
    """The whole picture as SVG. Raises DrawingError when the layers are not those of the code."""
    graph = grimp.build_graph("r2p", exclude_type_checking_imports=False)
    _check(graph)
    rows: list[str] = []
    top = float(_MARGIN)
    for label, packages in LAYERS.items():
        boxes = [(each, _files(graph, f"r2p.{each}")) for each in packages]
        height = _row_height(boxes)
        rows += _row(label, boxes, top, height)
        top += height + _GAP
    return "\n".join([_HEADER % top, *(f"  {each}" for each in rows), "</svg>\n"])


def _check(graph: grimp.ImportGraph) -> None:
    for package in (f"r2p.{each}" for packages in LAYERS.values() for each in packages):
        if package not in graph.modules:
            raise DrawingError(f"{package} does not exist: remove it from LAYERS")
    for module in sorted(graph.modules - {"r2p", "r2p.__main__"}):
        layer = _layer_of(module)
        for imported in sorted(graph.find_modules_directly_imported_by(module) - {"r2p"}):
            if _layer_of(imported) < layer:
                raise DrawingError(f"{module} imports {imported}, which is in a layer above its own")


def _layer_of(module: str) -> int:
    """The number of its row."""
    path = module.removeprefix("r2p.")
    for number, packages in enumerate(LAYERS.values()):
        if any(path == each or path.startswith(f"{each}.") for each in packages):
            return number
    raise DrawingError(f"{module} is in no layer: give it a place in LAYERS")


def _files(graph: grimp.ImportGraph, package: str) -> list[str]:
    """The names of a package's files, and of those of its packages that have no box of their own."""
    boxes = {f"r2p.{each}" for packages in LAYERS.values() for each in packages}
    return sorted(each.rpartition(".")[2] for each in graph.find_children(package) - boxes)


def _row_height(boxes: Sequence[tuple[str, list[str]]]) -> float:
    width = _box_width(len(boxes))
    return _HEAD + _LINE * max(len(_lines(files, width)) for _, files in boxes) + 2 * _GAP


def _box_width(boxes: int) -> float:
    return (_WIDTH - 2 * _MARGIN - _LABEL - _GAP * boxes) / boxes


def _lines(files: list[str], width: float) -> list[str]:
    return wrap(", ".join(files), int((width - 2 * _GAP) / _CHARACTER))


def _row(label: str, boxes: Sequence[tuple[str, list[str]]], top: float, height: float) -> Iterator[str]:
    wide = _WIDTH - 2 * _MARGIN
    yield f'<rect class="layer" x="{_MARGIN}" y="{top:.0f}" width="{wide}" height="{height:.0f}" rx="9"/>'
    for number, line in enumerate(wrap(label, int((_LABEL - _GAP) / 8))):
        yield _text("label", _MARGIN + _GAP, top + 26 + 18 * number, line)
    width = _box_width(len(boxes))
    for column, (name, files) in enumerate(boxes):
        left = _MARGIN + _LABEL + column * (width + _GAP)
        size = f'width="{width:.0f}" height="{height - 2 * _GAP:.0f}"'
        yield f'<rect class="box" x="{left:.0f}" y="{top + _GAP:.0f}" {size} rx="7"/>'
        yield _text("name", left + _GAP, top + _GAP + 20, name.replace(".", "/") + (".py" if not files else ""))
        for number, line in enumerate(_lines(files, width)):
            yield _text("files", left + _GAP, top + _GAP + _HEAD + 8 + _LINE * number, line)


def _text(style: str, x: float, y: float, text: str) -> str:
    return f'<text class="{style}" x="{x:.0f}" y="{y:.0f}">{escape(text)}</text>'


if __name__ == "__main__":
    PICTURE.write_text(draw(), encoding="utf-8")
