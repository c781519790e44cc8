// The graph of nodes and topics: what is published where, how fast, and which edges lose messages or miss deadlines.

import { button, field, filterBox, h, memory, pauseButton, renew, setText } from "./dom.js"
import { count, fixed, plural, UNKNOWN } from "./format.js"
import { GraphDrawing } from "./graph_drawing.js"
import { graphOf, Growth, nodeId, shapeOf, topicId } from "./graph_model.js"

const LIMIT = 400 // elements that are drawn; more of them no one can read

export const graph = {
  id: "graph",
  title: "Graph",
  keys: [
    ["← → ↑ ↓", "to the neighbours of a box, and beside it"],
    ["Enter", "what a box is"],
    ["+ -", "zoom"],
    ["f", "fit all of it"],
  ],
  create: app => new GraphView(app),
}

class GraphView {
  #app
  #growth = new Growth()
  #drawing = new GraphDrawing(id => this.#select(id))
  #options = { all: false, byModule: memory.get("graph-by-module", false), words: [] }
  #shape = null
  #graph = { elements: new Map(), edges: new Map(), left: 0 }
  #troubles = new Map()
  #selected = null
  #paused = false
  #asList = false
  #note = h("p", { class: "dim graph-note", role: "status" })
  #details = h("aside", { class: "panel details", "aria-label": "Details", hidden: true })
  #list = h("div", {
    class: "table-box", hidden: true, tabindex: "0", role: "region", "aria-label": "The graph as a list",
  })
  #update = () => this.#paused || this.#refresh()

  constructor(app) {
    this.#app = app
    this.element = h("section", { class: "view full graph-view" }, this.#bar(), this.#note,
      h("div", { class: "fill graph-body" }, this.#drawing.element, this.#list, this.#details))
  }

  show(argument) {
    this.#app.store.addEventListener("change", this.#update)
    this.#refresh()
    if (argument) this.#open(argument)
  }

  hide() {
    this.#app.store.removeEventListener("change", this.#update)
  }

  key(event) {
    if (event.key === "f") this.#drawing.fit()
    else if (event.key === "+" || event.key === "=") this.#drawing.zoomBy(1.25)
    else if (event.key === "-") this.#drawing.zoomBy(0.8)
    else if (event.key === "Escape" && this.#selected) this.#select(null)
    else return false
    return true
  }

  #bar() {
    const grain = h("select", { onchange: () => {
      this.#options.byModule = grain.value === "modules"
      memory.set("graph-by-module", this.#options.byModule)
      this.#refresh()
    } }, h("option", { value: "nodes" }, "nodes"), h("option", { value: "modules" }, "modules"))
    grain.value = this.#options.byModule ? "modules" : "nodes"
    const all = h("input", { type: "checkbox", onchange: () => {
      this.#options.all = all.checked
      this.#refresh()
    } })
    const zoom = (text, factor, name) => (
      button(text, () => this.#drawing.zoomBy(factor), { "aria-label": name, title: name }))
    const list = button("List", () => this.#showList(list), { "aria-pressed": "false", dataset: { list: "" } })
    return h("div", { class: "bar" },
      h("h2", {}, "Graph"),
      filterBox("Filter nodes and topics", text => {
        this.#options.words = text.toLowerCase().split(/\s+/).filter(Boolean)
        this.#refresh()
      }),
      field("By", grain),
      h("label", { class: "check", title: "Also those of services, logs and this tool" }, all, "all topics"),
      h("span", { class: "space" }),
      pauseButton(paused => {
        this.#paused = paused
        this.#update()
      }),
      zoom("−", 0.8, "Zoom out"), zoom("+", 1.25, "Zoom in"),
      button("Fit", () => this.#drawing.fit(), { title: "Fit all of it (f)" }), list)
  }

  #showList(toggle) {
    this.#asList = !this.#asList
    toggle.setAttribute("aria-pressed", this.#asList)
    this.#list.hidden = !this.#asList
    this.#drawing.element.toggleAttribute("hidden", this.#asList)
    this.#refresh()
  }

  #refresh() {
    this.#graph = graphOf(this.#app.store, { ...this.#options, limit: LIMIT })
    this.#noteTroubles()
    const shape = shapeOf(this.#graph)
    if (shape !== this.#shape) this.#drawing.draw(this.#graph)
    this.#shape = shape
    this.#drawing.update(this.#graph, this.#troubles)
    this.#describe()
    if (this.#asList) this.#drawList()
    this.#drawDetails()
  }

  #noteTroubles() {
    const time = this.#app.store.time / 1e9
    this.#troubles = new Map([...this.#graph.edges.values()].flatMap(edge => {
      const missed = this.#growth.note(`${edge.key}\nmissed`, edge.missed, time)
      const lost = this.#growth.note(`${edge.key}\nlost`, edge.lost, time)
      const text = [missed && `${missed} missed`, lost && `${lost} lost`].filter(Boolean).join(", ")
      return text ? [[edge.key, text]] : []
    }))
  }

  #describe() {
    const { elements, left } = this.#graph
    const topics = [...elements.values()].filter(element => element.kind === "topic").length
    const said = elements.size
      ? `${plural(topics, "topic")}, ${plural(elements.size - topics, this.#options.byModule ? "module" : "node")}`
      : this.#options.words.length ? "Nothing matches the filter" : "No nodes and topics yet"
    const rest = left ? ` · ${left} more are not drawn: use the filter, or the list` : ""
    const bad = this.#troubles.size ? ` · ${plural(this.#troubles.size, "edge")} with misses or losses` : ""
    setText(this.#note, said + bad + rest)
    Object.assign(this.element.dataset, { topics, nodes: elements.size - topics, edges: this.#graph.edges.size })
  }

  // The list

  #drawList() {
    const { elements, edges } = graphOf(this.#app.store, this.#options)
    const lists = new Map([...elements.values()].filter(each => each.kind === "topic")
      .map(each => [each.label, { topic: each.topic, publish: [], subscribe: [], trouble: [] }]))
    for (const edge of edges.values()) {
      const list = lists.get(edge.topic)
      list[edge.role].push(labelOf(edge.role === "publish" ? edge.from : edge.to))
      if (this.#troubles.has(edge.key)) list.trouble.push(this.#troubles.get(edge.key))
    }
    const heads = ["Topic", "Rate Hz", "From", "To", "Misses and losses"]
    const rows = [...lists].sort(([one], [other]) => (one < other ? -1 : 1)).map(([name, list]) => h("tr", {},
      h("th", { scope: "row" }, h("a", { href: this.#app.address("graph", name) }, name)),
      h("td", { class: "number" }, list.topic.rate === undefined ? UNKNOWN : fixed(list.topic.rate)),
      h("td", { class: "names" }, list.publish.join(", ") || UNKNOWN),
      h("td", { class: "names" }, list.subscribe.join(", ") || UNKNOWN),
      h("td", { class: "bad" }, list.trouble.join(", "))))
    renew(this.#list, h("table", { class: "plain" },
      h("caption", { class: "sr-only" }, "Topics, and the nodes that publish and subscribe to them"),
      h("thead", {}, h("tr", {}, heads.map((head, index) => (
        h("th", { scope: "col", class: index === 1 ? "number" : null }, head))))),
      h("tbody", {}, rows)))
  }

  // Details

  #open(argument) {
    const id = [topicId(argument), nodeId(argument)].find(each => this.#graph.elements.has(each))
    if (id) this.#select(id)
  }

  #select(id) {
    this.#selected = id
    this.#drawing.mark(id)
    this.#app.rename("graph", id ? labelOf(id) : "")
    this.#drawDetails()
  }

  #drawDetails() {
    const element = this.#graph.elements.get(this.#selected)
    const shown = element ? this.#detailsOf(element) : null
    this.#details.hidden = !element
    if (!element || shown === this.#details.dataset.shown) return
    this.#details.dataset.shown = shown
    const focused = this.#details.contains(document.activeElement) ? document.activeElement.textContent : null
    const { facts, lists } = JSON.parse(shown)
    this.#details.replaceChildren(
      h("div", { class: "head" }, h("h2", { class: "wrap" }, element.label), h("span", { class: "chip" }, element.kind),
        h("span", { class: "space" }),
        button("×", () => this.#select(null), { class: "quiet close", "aria-label": "Close details" })),
      h("dl", { class: "facts" }, facts.map(([name, value, tone]) => (
        [h("dt", {}, name), h("dd", { dataset: { tone: tone ?? "" } }, value)])).flat()),
      ...this.#neighbours(lists).flat(), ...this.#links(element))
    if (focused) [...this.#details.querySelectorAll("button, a")].find(each => each.textContent === focused)?.focus()
  }

  // Return what is shown of an element, as a text: it tells whether that has changed.
  #detailsOf(element) {
    const around = [...this.#graph.edges.values()].filter(edge => edge.from === element.id || edge.to === element.id)
    const facts = element.kind === "topic" ? topicFacts(element.topic) : [["State", element.state || UNKNOWN]]
    for (const edge of around.filter(each => this.#troubles.has(each.key))) {
      const who = edge.role === "publish" ? "Publisher" : "Subscriber"
      facts.push([who, `${labelOf(other(edge, element))}: ${this.#troubles.get(edge.key)}`, "bad"])
    }
    const titles = element.kind === "topic" ? ["Published by", "Subscribed by"] : ["Publishes", "Subscribes to"]
    const lists = ["publish", "subscribe"].map((role, index) => [
      titles[index],
      around.filter(edge => edge.role === role).map(edge => [other(edge, element), edgeFacts(edge)]),
    ])
    return JSON.stringify({ facts, lists: lists.filter(([, list]) => list.length) })
  }

  #neighbours(lists) {
    const item = ([id, facts]) => h("li", {},
      button(labelOf(id), () => this.#select(id), { class: "quiet link" }), h("span", { class: "dim" }, facts))
    return lists.map(([title, list]) => [h("h3", {}, title), h("ul", {}, list.map(item))])
  }

  #links(element) {
    const app = this.#app
    const wanted = element.kind === "topic"
      ? [["overview", "All figures", `topic/${element.label}`], ["publish", "Publish", element.label]]
      : [["nodes", "Start and stop", element.module], ["parameters", "Parameters", element.module]]
    const isShown = view => !app.hello?.recording || !["publish", "parameters"].includes(view)
    const links = wanted.filter(([view]) => app.has(view) && isShown(view))
      .map(([view, text, argument]) => h("a", { class: "button", href: app.address(view, argument) }, text))
    return links.length ? [h("div", { class: "actions" }, links)] : []
  }
}

const other = (edge, element) => edge.from === element.id ? edge.to : edge.from

// The name of an element is what follows its kind in its id.
const labelOf = id => id.slice(id.indexOf(" ") + 1)

function edgeFacts({ publisherClass, rate }) {
  return [publisherClass, rate === null ? null : `${fixed(rate)} Hz`].filter(Boolean).join(", ")
}

function topicFacts(topic) {
  const facts = [
    ["Type", topic.type ?? UNKNOWN],
    ["Rate", topic.rate === undefined ? UNKNOWN : `${fixed(topic.rate)} Hz`],
    ["Size", topic.size === undefined ? UNKNOWN : `${topic.varies ? "up to " : ""}${count(topic.size)} B`],
    ["Missed", count(topic.missed)],
    ["Lost on the way", count(topic.lost_on_way)],
  ]
  if (topic.mismatch) facts.push(["Type", "publishers and subscribers have different types", "bad"])
  return facts
}
