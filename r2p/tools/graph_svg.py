"""The graph of nodes and topics as SVG, drawn in layers from left to right: the same graph is always the same picture.

Each topic is to the right of its publishers, and each node to the right of what it subscribes to, as far as that is
possible: an edge of a circle leads back. Within a layer, the order follows the neighbours, so that few edges cross.
"""

import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias
from xml.sax.saxutils import escape

import msgspec

from r2p.log_lines import printable

_SWEEPS = 8  # over all layers: more change next to nothing
_CHARACTER, _PAD, _GAP = 7.2, 12, 70  # px: of a text, beside it, between layers
_ROW, _BOX, _MARGIN = 52, 36, 20  # px: from one box to the next, the height of a box, around the picture
_LABEL_MAX = 30  # characters; the whole name is in the title
_STYLE = """
    text { font: 12px ui-monospace, Menlo, Consolas, monospace; fill: #24292f; text-anchor: middle }
    .small { font-size: 10px; fill: #57606a }
    .node { fill: #eaf2fb; stroke: #4e79a7 }
    .topic { fill: #fff; stroke: #8c959f }
    .edge { fill: none; stroke: #6e7781 }
    .arrow { fill: #6e7781 }
    .missed { stroke: #cf222e }
    @media (prefers-color-scheme: dark) {
      text { fill: #e6edf3 } .small { fill: #9ba5b1 }
      .node { fill: #1c2f45; stroke: #6ea8e0 } .topic { fill: #161b22; stroke: #8b949e }
      .edge { stroke: #8b949e } .arrow { fill: #8b949e } .missed { stroke: #ff7b72 }
    }"""


class GraphTopic(msgspec.Struct):
    """A topic, and the nodes that publish and subscribe to it, as MODULE/node; `rate` in Hz, if it is known."""

    name: str
    publishers: list[str]
    subscribers: list[str]
    rate: float | None = None
    missed: int | None = None

    @property
    def rate_text(self) -> str:
        """The rate, and the misses if there are any; empty: unknown."""
        rate = "" if self.rate is None else f"{self.rate:.4g} Hz"
        return f"{rate}, {self.missed} missed".removeprefix(", ") if self.missed else rate


class _Vertex(NamedTuple):
    """A box, or the place in a layer where a long edge passes (`via`)."""

    kind: str
    name: str
    via: int = 0


class _Edge(NamedTuple):
    """An edge from left to right; `back`: it was turned around."""

    start: _Vertex
    end: _Vertex
    back: bool = False


_Path: TypeAlias = list[_Vertex]
_Layers: TypeAlias = list[list[_Vertex]]


def draw(topics: Sequence[GraphTopic]) -> str:
    """Return the picture."""
    edges = _without_circles(_edges(topics))
    layers, paths = _layered(edges)
    _order(layers, paths)
    by_name = {each.name: each for each in topics}
    places, width, height = _places(layers)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img">',
        "  <title>nodes and topics</title>",
        f"  <style>{_STYLE}\n  </style>",
        *(_edge(edge, [places[each] for each in path], by_name) for edge, path in paths.items()),
        *(_box(vertex, places[vertex], by_name) for layer in layers for vertex in layer if vertex.kind != "via"),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _edges(topics: Iterable[GraphTopic]) -> list[_Edge]:
    found: list[_Edge] = []
    for each in topics:
        topic = _Vertex("topic", each.name)
        found += (_Edge(_Vertex("node", name), topic) for name in dict.fromkeys(each.publishers))
        found += (_Edge(topic, _Vertex("node", name)) for name in dict.fromkeys(each.subscribers))
    return found


def _without_circles(edges: list[_Edge]) -> list[_Edge]:
    """Turn around the edges that close a circle, found by a search in depth."""
    after: dict[_Vertex, list[_Edge]] = defaultdict(list)
    for edge in edges:
        after[edge.start].append(edge)
    targets = {edge.end for edge in edges}
    starts = dict.fromkeys(edge.start for edge in edges)
    back: set[_Edge] = set()
    done: set[_Vertex] = set()
    for start in sorted(starts, key=lambda each: (each in targets, *each)):  # those that nothing leads to first
        _search(start, after, done, back)
    return [_Edge(each.end, each.start, back=True) if each in back else each for each in edges]


def _search(start: _Vertex, after: dict[_Vertex, list[_Edge]], done: set[_Vertex], back: set[_Edge]) -> None:
    """Note the edges that lead back to where the search has come from; without recursion, as graphs may be deep."""
    if start in done:
        return
    way, left = {start}, [(start, iter(after[start]))]
    while left:
        vertex, edges = left[-1]
        edge = next(edges, None)
        if edge is None:
            left.pop()
            way.remove(vertex)
            done.add(vertex)
        elif edge.end in way:
            back.add(edge)
        elif edge.end not in done:
            way.add(edge.end)
            left.append((edge.end, iter(after[edge.end])))


def _layered(edges: list[_Edge]) -> tuple[_Layers, dict[_Edge, _Path]]:
    """Return the layers, each in the order of names, and the places that each edge passes, its ends included."""
    depth = _depths(edges)
    layers: _Layers = [[] for _ in range(max(depth.values(), default=-1) + 1)]
    for vertex in sorted(depth):
        layers[depth[vertex]].append(vertex)
    paths: dict[_Edge, _Path] = {}
    for number, edge in enumerate(dict.fromkeys(edges)):
        between = [_Vertex("via", str(number), layer) for layer in range(depth[edge.start] + 1, depth[edge.end])]
        for vertex in between:
            layers[vertex.via].append(vertex)
        paths[edge] = [edge.start, *between, edge.end]
    return layers, paths


def _depths(edges: list[_Edge]) -> dict[_Vertex, int]:
    """Return the layer of each vertex: one more than that of the last one that leads to it."""
    depth = dict.fromkeys((vertex for edge in edges for vertex in edge[:2]), 0)
    after: dict[_Vertex, list[_Vertex]] = defaultdict(list)
    waits = dict.fromkeys(depth, 0)
    for edge in edges:
        after[edge.start].append(edge.end)
        waits[edge.end] += 1
    ready = [vertex for vertex, count in waits.items() if not count]
    for vertex in ready:  # grows meanwhile
        for target in after[vertex]:
            depth[target] = max(depth[target], depth[vertex] + 1)
            waits[target] -= 1
            if not waits[target]:
                ready.append(target)
    return depth


def _order(layers: _Layers, paths: dict[_Edge, _Path]) -> None:
    """Put the vertices of each layer in the order of their neighbours' mean places, to and fro."""
    before: dict[_Vertex, list[_Vertex]] = defaultdict(list)
    after: dict[_Vertex, list[_Vertex]] = defaultdict(list)
    for path in paths.values():
        for left, right in itertools.pairwise(path):
            before[right].append(left)
            after[left].append(right)
    place = {vertex: i for layer in layers for i, vertex in enumerate(layer)}
    for sweep in range(_SWEEPS):
        neighbours = after if sweep % 2 else before
        for layer in reversed(layers) if sweep % 2 else layers:
            _sort(layer, neighbours, place)
            place |= {vertex: i for i, vertex in enumerate(layer)}


def _sort(layer: list[_Vertex], neighbours: dict[_Vertex, list[_Vertex]], place: dict[_Vertex, int]) -> None:
    def mean(vertex: _Vertex) -> tuple[float, int]:
        near = [place[each] for each in neighbours[vertex]]
        return (sum(near) / len(near) if near else place[vertex], place[vertex])

    layer.sort(key=mean)


class _Place(NamedTuple):
    """The middle of a box, and its width."""

    x: float
    y: float
    width: float


def _places(layers: _Layers) -> tuple[dict[_Vertex, _Place], float, float]:
    """Return the place of each vertex, and the width and height of the picture."""
    highest = max(map(len, layers), default=0)
    places: dict[_Vertex, _Place] = {}
    x: float = _MARGIN
    for layer in layers:
        width = max((_width(vertex) for vertex in layer), default=0)
        top = _MARGIN + (highest - len(layer)) * _ROW / 2 + _ROW / 2
        for i, vertex in enumerate(layer):
            places[vertex] = _Place(x + width / 2, top + i * _ROW, width if vertex.kind == "via" else _width(vertex))
        x += width + _GAP
    return places, max(x - _GAP, 0) + _MARGIN, highest * _ROW + 2 * _MARGIN


def _width(vertex: _Vertex) -> float:
    """Return the width of a box; 0 for the place of an edge."""
    if vertex.kind == "via":
        return 0
    longest = max(map(len, _labels(vertex)))
    return max(longest, 12) * _CHARACTER + 2 * _PAD


def _labels(vertex: _Vertex) -> list[str]:
    """Return the lines of a box: of a node its module and its name."""
    parts = vertex.name.rsplit("/", 1) if vertex.kind == "node" else [vertex.name]
    return [_cut(printable(each)) for each in parts]


def _cut(name: str) -> str:
    return name if len(name) <= _LABEL_MAX else f"{name[:9]}…{name[len(name) - _LABEL_MAX + 10 :]}"


def _edge(edge: _Edge, places: list[_Place], topics: dict[str, GraphTopic]) -> str:
    """Return a line through all of its places, with its arrow at the end of the message's way."""
    first, *others = places
    x, y = first.x + first.width / 2, first.y
    steps = [f"M{x:.1f} {y:.1f}"]
    for place in others:
        left, right = place.x - place.width / 2, place.x + place.width / 2
        middle = (x + left) / 2
        steps.append(f"C{middle:.1f} {y:.1f} {middle:.1f} {place.y:.1f} {left:.1f} {place.y:.1f}")
        if place is not places[-1]:
            steps.append(f"L{right:.1f} {place.y:.1f}")
        x, y = right, place.y
    tip, side = (first.x + first.width / 2, 8) if edge.back else (places[-1].x - places[-1].width / 2, -8)
    at = first.y if edge.back else places[-1].y
    arrow = f"M{tip:.1f} {at:.1f}l{side} -4v8z"
    topic = topics[(edge.start if edge.start.kind == "topic" else edge.end).name]
    missed = " missed" if topic.missed else ""
    return f'  <path class="edge{missed}" d="{" ".join(steps)}"/><path class="arrow" d="{arrow}"/>'


def _box(vertex: _Vertex, place: _Place, topics: dict[str, GraphTopic]) -> str:
    """Return a box with its name, and of a topic its rate."""
    x, y = place.x - place.width / 2, place.y - _BOX / 2
    radius = 4 if vertex.kind == "node" else _BOX / 2
    rate = topics[vertex.name].rate_text if vertex.kind == "topic" else ""
    labels = _labels(vertex) if vertex.kind == "node" else [*_labels(vertex), *([rate] if rate else [])]
    small = 0 if vertex.kind == "node" else 1
    texts = [
        f'<text{" class=" + chr(34) + "small" + chr(34) if i == small and len(labels) > 1 else ""} x="{place.x:.1f}" '
        f'y="{place.y + 4 + (i - (len(labels) - 1) / 2) * 13:.1f}">{escape(label)}</text>'
        for i, label in enumerate(labels)
    ]
    return (
        f"  <g><title>{escape(printable(vertex.name))}</title>"
        f'<rect class="{vertex.kind}" x="{x:.1f}" y="{y:.1f}" width="{place.width:.1f}" height="{_BOX}" '
        f'rx="{radius:g}"/>{"".join(texts)}</g>'
    )
