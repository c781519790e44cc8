// The overview: what `r2p top` shows. Its address may name what is opened beside it: #/overview/topic/NAME or
// #/overview/module/NAME.

import { BusCard } from "./bus_card.js"
import { filterBox, h, memory, oncePerFrame, pauseButton, place, setText } from "./dom.js"
import { count, duration, fixed, kilobytes, milliseconds, percent, total, UNKNOWN } from "./format.js"
import { ModuleDetail } from "./module_detail.js"
import { LiveTable } from "./table.js"
import { TopicDetail } from "./topic_detail.js"

const CLASSES = { periodic: "P", sporadic: "S", "non real-time": "N" }
const CLASS_HINT = "P periodic, S sporadic, N non real-time"

function classesOf(topic) {
  const found = new Set((topic.publishers ?? []).map(each => CLASSES[each.publisher_class]).filter(Boolean))
  return [...found].sort().join(" ") || null
}

// Losses are said where there are some, and "-" only where they are not known.
function losses(id, title, value, hint, level = 2) {
  return { id, title, hint, level, number: true, value, text: row => count(value(row)), tone: row => value(row) ? "bad" : "dim" }
}

function lostBy(counters) {
  return counters ? total(Object.values(counters)) ?? 0 : null
}

function describeLost(counters) {
  return Object.entries(counters ?? {}).map(([reason, size]) => `${reason} ${size}`).join(", ")
}

const TOPIC_COLUMNS = [
  { id: "name", title: "Topic", value: row => row.name, link: row => `#/overview/topic/${encodeURIComponent(row.name)}` },
  { id: "type", title: "Type", level: 4, value: row => row.type, tone: row => row.mismatch ? "bad" : "dim",
    text: row => row.mismatch ? `${row.type ?? ""} types differ` : row.type },
  { id: "class", title: "Class", level: 3, hint: CLASS_HINT, value: classesOf },
  { id: "publishers", title: "Pub", hint: "Publishers", number: true, level: 3, value: row => row.publishers?.length ?? 0,
    tone: row => row.publishers?.length ? "" : "warn" },
  { id: "subscribers", title: "Sub", hint: "Subscribers", number: true, level: 3, value: row => row.subscribers?.length ?? 0 },
  { id: "rate", title: "Rate", unit: "Hz", number: true, value: row => row.rate, text: row => fixed(row.rate),
    hint: "Messages per second of all publishers" },
  { id: "size", title: "Size", unit: "B", number: true, level: 3, value: row => row.size,
    text: row => row.varies && row.size ? `≤ ${row.size}` : count(row.size) },
  { id: "bandwidth", title: "Load", unit: "kB/s", number: true, level: 2, value: row => row.bandwidth,
    text: row => kilobytes(row.bandwidth) },
  { id: "laxity", title: "Laxity", unit: "ms", number: true, level: 4, value: row => row.laxity,
    hint: "The least time that was left to a deadline", text: row => milliseconds(row.laxity),
    tone: row => row.laxity < 0 ? "bad" : "" },
  { id: "p50", title: "p50", unit: "ms", number: true, level: 4, value: row => row.latency?.p50,
    hint: "Median latency of a topic that is open", text: row => milliseconds(row.latency?.p50) },
  { id: "p99", title: "p99", unit: "ms", number: true, level: 4, value: row => row.latency?.p99,
    hint: "Latency of 99 % of the messages of a topic that is open", text: row => milliseconds(row.latency?.p99) },
  losses("missed", "Missed", row => row.missed, "Deadlines that publishers missed", 1),
  losses("late", "Late", row => row.late, "Messages that were published late", 4),
  losses("way", "Lost", row => row.lost_on_way, "Lost on the way: by links, gateways and subscribers", 1),
  losses("here", "Tool", row => row.lost_here, "Lost by r2p dash itself", 4),
]

const MODULE_COLUMNS = [
  { id: "name", title: "Module", value: row => row.name, link: row => `#/overview/module/${encodeURIComponent(row.name)}` },
  { id: "state", title: "State", value: row => row.state, tone: row => stateTone(row) },
  { id: "release", title: "Version", level: 2, value: row => row.release },
  { id: "age", title: "Heard", unit: "s", number: true, value: row => row.age, text: row => fixed(row.age),
    hint: "How long ago the module was last heard" },
  { id: "uptime", title: "Up", number: true, level: 2, value: row => row.uptime, text: row => duration(row.uptime) },
  { id: "cpu", title: "CPU", unit: "%", number: true, level: 2, value: row => row.cpu, text: row => percent(row.cpu) },
  { id: "answers", title: "Statistics", level: 3, value: row => answers(row), tone: row => row.answers === false ? "warn" : "dim" },
  { id: "link", title: "Link", level: 4, value: row => row.link || null, tone: () => "dim" },
]

function stateTone(row) {
  if (row.rebooted) return "warn"
  return ["running", "observer"].includes(row.state) ? "" : row.state === "lost" ? "bad" : "warn"
}

function answers(row) {
  return row.answers === undefined ? null : row.answers ? "answers" : "no answer"
}

const LINK_COLUMNS = [
  { id: "name", title: "Link", value: row => `${row.module} ${row.name}` },
  { id: "up", title: "State", value: row => row.up ? "up" : "down", tone: row => row.up ? "" : "bad" },
  { id: "sent", title: "Out", unit: "1/s", number: true, value: row => row.sent, text: row => fixed(row.sent) },
  { id: "received", title: "In", unit: "1/s", number: true, value: row => row.received, text: row => fixed(row.received) },
  { id: "bytes_sent", title: "Out", unit: "kB/s", number: true, level: 3, value: row => row.bytes_sent,
    text: row => kilobytes(row.bytes_sent) },
  { id: "bytes_received", title: "In", unit: "kB/s", number: true, level: 3, value: row => row.bytes_received,
    text: row => kilobytes(row.bytes_received) },
  { id: "waiting", title: "Waiting", number: true, level: 3, value: row => row.waiting },
  losses("lost", "Lost", row => lostBy(row.lost), "Messages that this link lost"),
  { id: "why", title: "Why", level: 4, value: row => describeLost(row.lost) || describeLost(row.faults) || null, tone: () => "dim" },
]

const SERVICE_COLUMNS = [
  { id: "name", title: "Service", value: row => row.name, link: row => `#/services/${encodeURIComponent(row.name)}` },
  { id: "type", title: "Type", level: 3, value: row => row.type, tone: () => "dim" },
  { id: "servers", title: "Served by", level: 2, value: row => (row.servers ?? []).join(", ") || null,
    tone: row => row.servers?.length ? "" : "warn" },
  { id: "running", title: "Running", number: true, value: row => row.running },
  { id: "waiting", title: "Waiting", number: true, level: 2, value: row => row.waiting },
  { id: "handled", title: "Handled", number: true, value: row => row.handled },
  losses("failed", "Failed", row => row.failed, "Calls whose handler failed"),
  losses("refused", "Refused", row => row.refused, "Calls that were refused, as too many were running"),
]

const TABLES = [
  ["topics", "Topics", TOPIC_COLUMNS, row => row.name, "No topics yet: nothing publishes or subscribes"],
  ["modules", "Modules", MODULE_COLUMNS, row => row.name, "No modules yet"],
  ["links", "Links", LINK_COLUMNS, row => `${row.module} ${row.name}`, "No module says anything of its links"],
  ["services", "Services", SERVICE_COLUMNS, row => row.name, "No services"],
]

export const overview = {
  id: "overview",
  title: "Overview",
  keys: [["Enter", "open the topic or module that has the keyboard"], ["Esc", "close it"]],
  create: app => new OverviewView(app),
}

class OverviewView {
  #app
  #paused = false
  #tables = new Map()
  #buses = new Map()
  #busBox = h("div", { class: "bus-cards" })
  #totals = new Map()
  #counts = new Map()
  #ofServices
  #internal = memory.get("internal", false)
  #aside = h("aside", { class: "detail", hidden: true, "aria-label": "Detail" })
  #detail = null
  #opener = null // has the keyboard again when the detail is closed
  #draw = oncePerFrame(() => this.#update())

  constructor(app) {
    this.#app = app
    const filter = filterBox("Filter topics, modules, links and services", text => this.#filter(text))
    this.#ofServices = this.#internalBox()
    const bar = h("div", { class: "bar" },
      h("h2", { class: "sr-only" }, "Overview"), filter, pauseButton(paused => this.#pause(paused)), this.#ofServices)
    const sections = TABLES.map(table => this.#section(...table))
    const busSection = h("section", { class: "overview-section", id: "overview-buses" }, h("h2", {}, "Buses"), this.#busBox)
    this.busSection = busSection
    this.element = h("div", { class: "overview" },
      h("section", { class: "view" }, bar, this.#totalsList(), sections[0], busSection, ...sections.slice(1)), this.#aside)
  }

  show(argument) {
    const [, kind, name] = argument.match(/^(topic|module)\/(.*)$/s) ?? []
    this.#app.store.removeEventListener("change", this.#draw)
    this.#app.store.addEventListener("change", this.#draw)
    this.#open(kind, name)
    this.#update()
  }

  hide() {
    this.#app.store.removeEventListener("change", this.#draw)
    this.#open()
  }

  key(event) {
    if (event.key !== "Escape" || !this.#detail) return false
    this.#app.open("overview")
    return true
  }

  #section(id, title, columns, key, empty) {
    const table = new LiveTable({
      id, caption: title, columns, key, sort: columns[0].id, empty,
      search: row => [key(row), row.type, row.state, row.link, ...(row.publishers ?? []).map(each => `${each.module}/${each.node}`)].join(" "),
    })
    this.#tables.set(id, table)
    const counts = h("span", { class: "dim" })
    this.#counts.set(id, counts)
    return h("section", { class: "overview-section", id: `overview-${id}` },
      h("div", { class: "head" }, h("h2", {}, title), counts), table.element)
  }

  #internalBox() {
    const box = h("input", { type: "checkbox", id: "overview-internal", checked: this.#internal, onchange: () => {
      this.#internal = box.checked
      memory.set("internal", box.checked)
      this.#update({ always: true })
    } })
    return h("label", { class: "check", title: "Topics that carry the calls of services", hidden: true }, box, "Topics of services")
  }

  // The sums above the tables; a click on one goes to its table.
  #totalsList() {
    const item = (id, title, target) => {
      const value = h("span", { class: "total-value" }, UNKNOWN)
      this.#totals.set(id, value)
      const act = () => document.getElementById(`overview-${target}`).scrollIntoView({ block: "start", behavior: "smooth" })
      const text = [value, h("span", { class: "dim" }, title)]
      return h("li", {}, h("button", { type: "button", class: "quiet total", onclick: act }, ...text))
    }
    return h("ul", { class: "totals", "aria-label": "Totals" },
      item("modules", "modules", "modules"), item("topics", "topics", "topics"), item("rate", "messages/s", "topics"),
      item("bandwidth", "kB/s", "topics"), item("bus", "% of the bus", "buses"), item("missed", "missed", "topics"),
      item("lost", "lost", "links"))
  }

  #filter(text) {
    for (const table of this.#tables.values()) table.filter(text)
    this.#count()
  }

  #pause(paused) {
    this.#paused = paused
    this.element.classList.toggle("paused", paused)
    this.#update()
  }

  #update({ always = false } = {}) {
    if (this.#paused && !always) return
    const { store } = this.#app
    const all = [...store.topics.values()]
    const topics = all.filter(topic => this.#internal || !topic.is_of_service)
    this.#ofServices.hidden = !all.some(topic => topic.is_of_service)
    this.#tables.get("topics").update(topics)
    for (const id of ["modules", "links", "services"]) this.#tables.get(id).update(store[id].values())
    this.#updateBuses([...store.buses.values()])
    this.#updateTotals(topics, [...store.buses.values()])
    this.#count()
    this.#detail?.update()
  }

  #count() {
    for (const [id, table] of this.#tables) {
      const { shown, all } = table.counts
      setText(this.#counts.get(id), shown === all ? all : `${shown} of ${all}`)
    }
  }

  #updateBuses(buses) {
    const cards = buses.map(bus => {
      const card = this.#buses.get(bus.name) ?? new BusCard()
      this.#buses.set(bus.name, card)
      card.update(bus)
      return card.element
    })
    this.busSection.hidden = !cards.length
    place(this.#busBox, cards)
  }

  #updateTotals(topics, buses) {
    const { store } = this.#app
    const say = (id, text, tone = "") => {
      setText(this.#totals.get(id), text)
      this.#totals.get(id).dataset.tone = tone
    }
    const missed = total(topics.map(topic => topic.missed))
    const lost = total(topics.map(topic => topic.lost_on_way))
    const shares = buses.map(bus => bus.share).filter(share => share !== undefined)
    say("modules", store.modules.size)
    say("topics", topics.length)
    say("rate", fixed(total(topics.map(topic => topic.rate)), 0))
    say("bandwidth", kilobytes(total(topics.map(topic => topic.bandwidth))))
    say("bus", shares.length ? percent(Math.max(...shares)) : UNKNOWN)
    say("missed", count(missed), missed ? "bad" : "")
    say("lost", count(lost), lost ? "bad" : "")
  }

  #open(kind, name) {
    if (this.#detail?.kind === kind && this.#detail?.name === name) return
    if (kind && !this.#detail) this.#opener = document.activeElement
    this.#detail?.close()
    this.#detail = null
    if (kind === "topic") this.#detail = new TopicDetail(this.#app, name)
    if (kind === "module") this.#detail = new ModuleDetail(this.#app, name)
    this.#aside.hidden = !this.#detail
    this.element.classList.toggle("with-detail", Boolean(this.#detail))
    if (!this.#detail) return this.#opener?.focus()
    this.#aside.setAttribute("aria-label", `${kind} ${name}`)
    this.#aside.replaceChildren(this.#detail.element)
    this.#aside.scrollTop = 0
    this.#detail.heading.focus({ preventScroll: true })
  }
}
