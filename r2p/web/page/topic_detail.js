// One topic: its figures, its publishers and subscribers, and the fields of its newest message while they change.

import { detailHead, FactList, plainTable, section } from "./detail.js"
import { button, color, h, renew, setText } from "./dom.js"
import { clock, count, fixed, kilobytes, milliseconds, number, UNKNOWN } from "./format.js"

const SHOWN_MAX = 300 // fields
const ELEMENTS = 32 // of an array
const HISTORY = 120 // values of a sparkline
const SOURCES = { counters: "counted by the publishers", bus: "frames on the bus", measured: "measured here" }

export class TopicDetail {
  kind = "topic"
  #app
  #facts = new FactList()
  #actions = h("p", { class: "actions" })
  #publishers = h("div", { class: "table-box" })
  #subscribers = h("div", { class: "table-box" })
  #message = h("p", { class: "dim", role: "status" }, "waiting for a message")
  #fields = h("table", { class: "fields" })
  #rows = new Map()
  #row = undefined
  #failed = false
  #watch = () => this.#ask()
  #take = event => event.detail.topic === this.name && this.#show(event.detail)

  constructor(app, name) {
    this.#app = app
    this.name = name
    const head = detailHead("Topic", name)
    this.heading = head.heading
    this.#fields.append(h("caption", { class: "sr-only" }, "Fields of the newest message"), h("tbody"))
    this.element = h("div", {}, head.element, this.#facts.element, this.#actions,
      section("Newest message", this.#message, this.#fields),
      section("Publishers", this.#publishers), section("Subscribers", this.#subscribers))
    app.connection.addEventListener("message", this.#take)
    app.connection.addEventListener("hello", this.#watch)
    if (app.hello) this.#ask()
  }

  update() {
    const topic = this.#app.store.topics.get(this.name)
    if (topic === this.#row) return
    this.#row = topic
    if (this.#failed) this.#ask() // its type may be known now
    if (!topic) return this.#facts.update([["State", "gone: it has neither publishers nor subscribers", "warn"]])
    this.#facts.update(figures(topic))
    this.#offer(topic)
    renew(this.#publishers, publishersOf(topic))
    renew(this.#subscribers, subscribersOf(topic))
  }

  close() {
    this.#app.connection.removeEventListener("message", this.#take)
    this.#app.connection.removeEventListener("hello", this.#watch)
    this.#app.connection.request("unwatch", { topic: this.name }).catch(() => {}) // a connection that is lost has ended it
  }

  #offer(topic) {
    const app = this.#app
    const views = [["graph", "Show in graph"], ["publish", "Publish"], ...isPose(topic) ? [["map", "Show on map"]] : []]
      .filter(([view]) => view !== "publish" || app.hello?.publish)
    if (this.#actions.children.length === views.length) return
    this.#actions.replaceChildren(...views.map(([view, text]) =>
      h("a", { class: "button", href: app.address(view, topic.name) }, text)))
  }

  async #ask() {
    this.#failed = false
    try {
      await this.#app.connection.request("watch", { topic: this.name })
    } catch (error) {
      this.#failed = true
      setText(this.#message, error.message)
    }
  }

  #show({ time, module, node, sequence, skipped, fields }) {
    const from = [module, node].filter(Boolean).join("/")
    const parts = [clock(time / 1e9, 3), from, sequence === undefined || sequence === null ? "" : `number ${sequence}`,
      skipped ? `${skipped} more came between` : ""]
    setText(this.#message, parts.filter(Boolean).join(" · "))
    const shown = flatten(fields, "", [])
    for (const [path, value] of shown.slice(0, SHOWN_MAX)) this.#showField(path, value)
  }

  #showField(path, value) {
    if (!this.#rows.has(path)) this.#rows.set(path, this.#addField(path, value))
    this.#rows.get(path).show(value)
  }

  #addField(path, value) {
    const plottable = ["number", "boolean"].includes(typeof value)
    const text = h("td", { class: "mono", colspan: plottable ? null : 3 })
    const canvas = h("canvas", { class: "spark", "aria-hidden": "true", width: 96, height: 20 })
    const name = `${this.name}.${path}`
    const plot = button("Plot", () => this.#plot(name), { class: "quiet", "aria-label": `Plot ${name}` })
    this.#fields.tBodies[0].append(h("tr", {}, h("th", { scope: "row", title: path }, path), text,
      plottable ? [h("td", {}, canvas), h("td", {}, plot)] : []))
    const history = []
    return {
      show: newest => {
        setText(text, shownValue(newest))
        if (plottable) drawSpark(canvas, history, Number(newest))
      },
    }
  }

  // Beside what is plotted already, as a plot of its own.
  #plot(name) {
    const { plotted } = this.#app
    const known = plotted.split(/[,+]/).includes(name)
    this.#app.open("plots", known ? plotted : plotted ? `${plotted},${name}` : name)
  }
}

function isPose(topic) {
  return /odom|pose|position/i.test(`${topic?.name} ${topic?.type}`)
}

function figures(topic) {
  const size = topic.size === undefined ? null : `${topic.varies ? "at most " : ""}${topic.size} B`
  const lost = value => [count(value), value ? "bad" : ""]
  const source = SOURCES[topic.rate_source]
  return [
    ["Type", topic.mismatch ? `${topic.type ?? "-"}: publishers and subscribers have different types` : topic.type, topic.mismatch ? "bad" : ""],
    ["Rate", topic.rate === undefined ? null : `${fixed(topic.rate)} Hz${source ? `, ${source}` : ""}`],
    ["Load", topic.bandwidth === undefined ? null : `${kilobytes(topic.bandwidth)} kB/s`],
    ["Size", size],
    ["Laxity left", topic.laxity === undefined ? null : `${milliseconds(topic.laxity)} ms`, topic.laxity < 0 ? "bad" : ""],
    ["Latency", topic.latency
      ? `${milliseconds(topic.latency.p50)} ms median, ${milliseconds(topic.latency.p99)} ms for 99 % of ${topic.latency.count}` : null],
    ["Missed by publishers", ...lost(topic.missed)],
    ["Published late", ...lost(topic.late)],
    ["Lost on the way", ...lost(topic.lost_on_way)],
    ["Lost by r2p dash", ...lost(topic.lost_here)],
  ]
}

function publishersOf({ publishers = [] }) {
  if (!publishers.length) return h("p", { class: "dim" }, "None")
  const rows = publishers.map(each => [
    name(each), each.publisher_class, fixed(each.rate), count(each.sent), count(each.missed), count(each.late), each.link || UNKNOWN])
  return plainTable("Publishers", ["Node", "Class", "Rate Hz", "Sent", "Missed", "Late", "Link"], rows, { numbers: [2, 3, 4, 5] })
}

function subscribersOf({ subscribers = [] }) {
  if (!subscribers.length) return h("p", { class: "dim" }, "None")
  const rows = subscribers.map(each => [name(each), count(each.waiting), lostOf(each.lost), each.link || UNKNOWN])
  return plainTable("Subscribers", ["Node", "Waiting", "Lost", "Link"], rows, { numbers: [1] })
}

function name({ module, node }) {
  return h("a", { href: `#/overview/module/${encodeURIComponent(module)}` }, `${module || "?"}/${node || "?"}`)
}

function lostOf(lost) {
  if (!lost) return UNKNOWN
  const known = Object.entries(lost).filter(([, size]) => size)
  return known.length ? h("span", { class: "bad" }, known.map(([reason, size]) => `${reason} ${size}`).join(", ")) : "0"
}

// Return [path, value] of all fields; arrays of numbers are one value.
function flatten(value, path, found) {
  if (found.length > SHOWN_MAX) return found
  if (Array.isArray(value) && value.some(each => typeof each === "object" && each !== null))
    value.slice(0, ELEMENTS).forEach((each, index) => flatten(each, `${path}[${index}]`, found))
  else if (typeof value === "object" && value !== null && !Array.isArray(value))
    for (const [part, each] of Object.entries(value)) flatten(each, path ? `${path}.${part}` : part, found)
  else found.push([path, value])
  return found
}

function shownValue(value) {
  if (typeof value === "number") return number(value, 6)
  if (!Array.isArray(value)) return value === null ? UNKNOWN : String(value)
  const more = value.length > ELEMENTS ? ` … ${value.length} in all` : ""
  return `[${value.slice(0, ELEMENTS).map(each => typeof each === "number" ? number(each, 4) : each).join(", ")}${more}]`
}

function drawSpark(canvas, history, value) {
  history.push(value)
  if (history.length > HISTORY) history.shift()
  const context = canvas.getContext("2d")
  const known = history.filter(Number.isFinite)
  const low = Math.min(...known)
  const high = Math.max(...known)
  const { width, height } = canvas
  context.clearRect(0, 0, width, height)
  context.strokeStyle = color("--accent")
  context.beginPath()
  history.forEach((each, index) => {
    const y = high > low ? height - 2 - (each - low) / (high - low) * (height - 4) : height / 2
    context.lineTo(index / (HISTORY - 1) * width, y)
  })
  context.stroke()
}
