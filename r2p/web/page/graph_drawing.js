// The graph as SVG: boxes for nodes, round ones for topics, and edges that say how fast messages go and what is lost.

import { setText } from "./dom.js"
import { fixed } from "./format.js"
import { arrange, edgeKey } from "./graph_layout.js"
import { short } from "./graph_model.js"
import { PanZoom } from "./pan_zoom.js"

const SVG = "http://www.w3.org/2000/svg"
const LETTER = 7.3 // px of a letter, at most
const LETTERS = 30
const HEIGHT = 30 // px of a box
const PADDING = 24 // px around the graph
const SCALE_MAX = 4
const SCALE_FIT = 1.1 // a small graph is not blown up beyond this
const BETTER = 1.15 // times as large another arrangement has to be, before a drawn graph is arranged anew

function s(tag, properties = {}, ...children) {
  const element = document.createElementNS(SVG, tag)
  for (const [name, value] of Object.entries(properties)) element.setAttribute(name, value)
  element.append(...children)
  return element
}

// Draws graphs of graph_model.js. `select(id)` is called for a click or Enter on an element, with null beside all.
export class GraphDrawing {
  #select
  #boxes = new Map()
  #edges = new Map()
  #places = new Map()
  #around = new Map()
  #size = { width: 1, height: 1 }
  #graph = null
  #updated = null
  #way = ""
  #view = { x: 0, y: 0, scale: 1 }
  #selected = null
  #focused = null
  #panZoom
  #fitted = true
  #scene = s("g")

  constructor(select) {
    this.#select = select
    this.element = s("svg", { class: "graph", role: "group", "aria-label": "Graph of nodes and topics" },
      s("defs", {}, arrow("arrow"), arrow("arrow-bad"), arrow("arrow-accent")), this.#scene)
    this.#panZoom = new PanZoom(this.element, {
      move: (dx, dy) => this.#move(dx, dy),
      zoom: (factor, x, y) => this.#zoom(factor, x, y),
    })
    this.element.addEventListener("click", event => this.#click(event))
    this.element.addEventListener("keydown", event => this.#key(event))
    new ResizeObserver(() => this.#resized()).observe(this.element)
  }

  // Draw another graph. The places of its parts depend on nothing but these, and on the direction that fits better.
  draw(graph) {
    this.#graph = graph
    const laid = this.#arrange(graph)
    this.#way = laid.way
    this.#place(graph, laid)
  }

  // Arrange the graph for the area; as long as the shape of that stays, so do all places.
  #arrange({ elements, edges }) {
    const boxes = [...elements.values()].map(({ id, label }) => ({
      id, height: HEIGHT, width: Math.round(short(label, LETTERS).length * LETTER) + 26,
    }))
    return arrange(boxes, [...edges.values()], this.#area())
  }

  #resized() {
    if (!this.#graph || !this.#fitted) return
    const laid = this.#arrange(this.#graph)
    if (laid.way !== this.#way || this.#scaleFor(laid) > BETTER * this.#scaleFor(this.#size)) this.#redraw()
    else this.fit()
  }

  // Draw the same graph again, arranged for another area.
  #redraw() {
    const [graph, troubles] = this.#updated ?? [this.#graph, new Map()]
    this.draw(graph)
    this.update(graph, troubles)
  }

  #place({ elements, edges }, { places, routes, width, height }) {
    this.#places = places
    this.#size = { width, height }
    this.#around = new Map([...elements.keys()].map(id => [id, []]))
    this.#edges = new Map([...edges.values()].map(edge => [edge.key, this.#edge(edge, routes.get(edgeKey(edge)))]))
    this.#boxes = new Map([...elements].map(([id, element]) => [id, this.#box(element, places.get(id))]))
    this.#scene.replaceChildren(
      ...[...this.#edges.values()].map(edge => edge.element), ...[...this.#boxes.values()].map(box => box.element))
    this.#focus(this.#boxes.has(this.#focused) ? this.#focused : this.#first(), { move: false })
    this.mark(this.#selected)
    if (this.#fitted) this.fit()
    else this.#show()
  }

  // Show newer figures of the same parts. `troubles` has texts of edges that need action, by key.
  update(graph, troubles) {
    const { elements, edges } = graph
    this.#updated = [graph, troubles]
    for (const [key, edge] of edges) this.#updateEdge(this.#edges.get(key), edge, troubles.get(key))
    for (const [id, element] of elements) this.#updateBox(this.#boxes.get(id), element)
  }

  // Mark an element and what it is connected with.
  mark(id) {
    this.#selected = this.#boxes.has(id) ? id : null
    this.element.classList.toggle("has-selection", this.#selected !== null)
    const near = new Set([this.#selected, ...(this.#around.get(this.#selected) ?? [])])
    for (const [each, box] of this.#boxes) {
      box.element.classList.toggle("near", near.has(each))
      box.element.setAttribute("aria-pressed", each === this.#selected)
    }
    for (const { element, edge } of this.#edges.values()) {
      const isNear = this.#selected !== null && (edge.from === this.#selected || edge.to === this.#selected)
      element.classList.toggle("near", isNear)
    }
    if (this.#selected) this.#focus(this.#selected, { move: false })
  }

  fit() {
    const { width, height } = this.#area()
    const { width: w, height: h } = this.#size
    const scale = this.#scaleFor(this.#size)
    this.#view = { scale, x: (width - w * scale) / 2, y: (height - h * scale) / 2 }
    this.#fitted = true
    this.#show()
  }

  #scaleFor(size) {
    const { width, height } = this.#area()
    return Math.min(SCALE_FIT, width / (size.width + 2 * PADDING), height / (size.height + 2 * PADDING))
  }

  zoomBy(factor) {
    this.#panZoom.zoomBy(factor)
  }

  #area() {
    const { width, height } = this.element.getBoundingClientRect()
    return { width: Math.max(1, width), height: Math.max(1, height) }
  }

  #move(dx, dy) {
    this.#view.x += dx
    this.#view.y += dy
    this.#fitted = false
    this.#show()
  }

  #zoom(factor, x, y) {
    const scale = Math.min(SCALE_MAX, Math.max(0.02, this.#view.scale * factor))
    const real = scale / this.#view.scale
    this.#view = { scale, x: x - (x - this.#view.x) * real, y: y - (y - this.#view.y) * real }
    this.#fitted = false
    this.#show()
  }

  #show() {
    const { x, y, scale } = this.#view
    this.#scene.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)}) scale(${scale.toFixed(4)})`)
    this.element.classList.toggle("small", scale < 0.45)
  }

  // Parts

  #box({ id, kind, label }, { x, y, width }) {
    const shape = s("rect", {
      x: x - width / 2, y: y - HEIGHT / 2, width, height: HEIGHT, rx: kind === "topic" ? HEIGHT / 2 : 4,
    })
    const title = s("title")
    title.textContent = label
    const text = s("text", { x, y: y + 4, "text-anchor": "middle" })
    text.textContent = short(label, LETTERS)
    const element = s("g", { class: `box ${kind}`, role: "button", tabindex: "-1" }, title, shape, text)
    element.dataset.id = id
    element.dataset.kind = kind
    return { element }
  }

  #updateBox(box, element) {
    const rate = element.topic?.rate === undefined ? "rate not known" : `${fixed(element.topic.rate)} Hz`
    const words = [`${element.kind} ${element.label}`, element.kind === "topic" ? rate : element.state]
    const text = words.filter(Boolean).join(", ")
    if (box.element.getAttribute("aria-label") !== text) box.element.setAttribute("aria-label", text)
    box.element.classList.toggle("still", ["stopped", "boot"].includes(element.state))
    box.element.classList.toggle("bad", Boolean(element.topic?.mismatch))
  }

  #edge(edge, points) {
    this.#around.get(edge.from).push(edge.to)
    this.#around.get(edge.to).push(edge.from)
    const path = s("path", { d: curve(points, this.#way) })
    const middle = points.length > 2 ? points[points.length / 2 | 0] : halfway(...points)
    const label = s("text", { x: middle.x, y: middle.y - 4, "text-anchor": "middle" })
    const element = s("g", { class: `edge ${edge.role}` }, path, label)
    element.dataset.edge = edge.key.replace("\n", " → ")
    return { element, label, edge }
  }

  #updateEdge(drawn, edge, trouble) {
    const rate = edge.role === "publish" && edge.rate !== null ? `${fixed(edge.rate)} Hz` : ""
    setText(drawn.label, [rate, trouble].filter(Boolean).join(" · "))
    drawn.element.classList.toggle("bad", Boolean(trouble))
  }

  // Clicks and keys: one element has the keyboard, arrows go to its neighbours and up and down in its layer.

  #click(event) {
    const id = event.target.closest?.(".box")?.dataset.id ?? null
    if (id) this.#focus(id, { move: true })
    this.#select(id)
  }

  #key(event) {
    if (["Enter", " "].includes(event.key) && this.#focused) this.#select(this.#focused)
    else if (event.key.startsWith("Arrow") && !event.shiftKey) this.#step(event.key)
    else if (!this.#panZoom.key(event)) return
    event.preventDefault()
    event.stopPropagation()
  }

  #step(key) {
    const here = this.#places.get(this.#focused)
    if (!here) return
    const [before, after, up, down] = this.#way === "right"
      ? ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"]
      : ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]
    const side = { [before]: -1, [after]: 1 }[key] ?? 0
    const step = { [up]: -1, [down]: 1 }[key] ?? 0
    const across = place => this.#way === "right" ? place.y - here.y : place.x - here.x
    const near = side ? this.#around.get(this.#focused) : [...this.#places.keys()]
    const fits = place => side
      ? Math.sign(place.layer - here.layer) === side
      : place.layer === here.layer && Math.sign(across(place)) === step
    const distance = place => Math.hypot(place.x - here.x, place.y - here.y)
    const next = near.filter(id => fits(this.#places.get(id)))
      .sort((one, other) => distance(this.#places.get(one)) - distance(this.#places.get(other)))[0]
    if (next) this.#focus(next, { move: true })
  }

  #first() {
    const places = [...this.#places].sort(([, one], [, other]) => one.layer - other.layer || one.y - other.y)
    return places[0]?.[0] ?? null
  }

  #focus(id, { move }) {
    this.#boxes.get(this.#focused)?.element.setAttribute("tabindex", "-1")
    this.#focused = id
    const box = this.#boxes.get(id)?.element
    box?.setAttribute("tabindex", "0")
    if (!move) return
    box.focus({ preventScroll: true })
    this.#reveal(id)
  }

  #reveal(id) {
    const { x, y } = this.#places.get(id)
    const { width, height } = this.#area()
    const shown = { x: x * this.#view.scale + this.#view.x, y: y * this.#view.scale + this.#view.y }
    const dx = Math.max(0, 60 - shown.x) - Math.max(0, shown.x - width + 60)
    const dy = Math.max(0, 30 - shown.y) - Math.max(0, shown.y - height + 30)
    if (dx || dy) this.#move(dx, dy)
  }
}

function arrow(id) {
  return s("marker", {
    id, viewBox: "0 0 8 8", refX: 7, refY: 4, markerWidth: 7, markerHeight: 7, orient: "auto-start-reverse",
  }, s("path", { d: "M 0 1 L 7 4 L 0 7 z" }))
}

// Return a path through points: curves between layers, straight lines through them.
function curve(points, way) {
  return points.map(({ x, y }, index) => {
    if (!index) return `M ${x} ${y}`
    if (index % 2 === 0) return `L ${x} ${y}`
    const { x: fromX, y: fromY } = points[index - 1]
    const [dx, dy] = way === "right" ? [(x - fromX) / 2, 0] : [0, (y - fromY) / 2]
    return `C ${fromX + dx} ${fromY + dy} ${x - dx} ${y - dy} ${x} ${y}`
  }).join(" ")
}

function halfway(one, other) {
  return { x: (one.x + other.x) / 2, y: (one.y + other.y) / 2 }
}
