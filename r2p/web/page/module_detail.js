// One module: its figures, its nodes with what they publish and subscribe, and its links.

import { detailHead, FactList, plainTable, section } from "./detail.js"
import { h, renew } from "./dom.js"
import { count, duration, fixed, kilobytes, percent, UNKNOWN } from "./format.js"

export class ModuleDetail {
  kind = "module"
  #app
  #facts = new FactList()
  #nodes = h("div")
  #links = h("div", { class: "table-box" })
  #row = undefined

  constructor(app, name) {
    this.#app = app
    this.name = name
    const head = detailHead("Module", name)
    this.heading = head.heading
    const links = [["nodes", "Nodes and orders"], ["parameters", "Parameters"], ["log", "Log"]]
      .filter(([view]) => app.has(view))
      .map(([view, text]) => h("a", { class: "button", href: app.address(view, name) }, text))
    this.element = h("div", {}, head.element, this.#facts.element, h("p", { class: "actions" }, links),
      section("Nodes", this.#nodes), section("Links", this.#links))
  }

  update() {
    const module = this.#app.store.modules.get(this.name)
    renew(this.#links, linksOf([...this.#app.store.links.values()].filter(link => link.module === this.name)))
    if (module === this.#row) return
    this.#row = module
    if (!module) return this.#facts.update([["State", "gone", "bad"]])
    this.#facts.update(figures(module))
    renew(this.#nodes, ...(module.nodes ?? []).map(node))
  }

  close() {
    this.#row = undefined
  }
}

function figures(module) {
  const answers = { true: "answers", false: "does not answer", undefined: "never asked: firmware has no statistics" }
  return [
    ["State", module.rebooted ? `${module.state}, has rebooted` : module.state, module.state === "lost" ? "bad" : ""],
    ["Kind", module.kind],
    ["Version", module.release],
    ["Heard", module.age === undefined ? null : `${fixed(module.age)} s ago`],
    ["Up for", module.uptime === undefined ? null : duration(module.uptime)],
    ["CPU", module.cpu === undefined ? null : `${percent(module.cpu)} % of a core`],
    ["Statistics", answers[module.answers], module.answers === false ? "warn" : ""],
    ["Link", module.link],
  ]
}

function node({ name, running, restarts, publishes = [], subscribes = [] }) {
  const state = running === undefined || running === null ? "" : running ? "running" : "stopped"
  const chips = [
    state ? h("span", { class: running ? "chip" : "chip warn" }, state) : null,
    restarts ? h("span", { class: "chip bad" }, `${restarts} restarts`) : null,
  ]
  return h("article", { class: "node" },
    h("div", { class: "head" }, h("strong", {}, name || "?"), ...chips.filter(Boolean)),
    topics("publishes", publishes), topics("subscribes", subscribes))
}

function topics(verb, names) {
  if (!names.length) return ""
  const links = names.flatMap((name, index) => [
    index ? ", " : "", h("a", { href: `#/overview/topic/${encodeURIComponent(name)}` }, name)])
  return h("p", {}, h("span", { class: "dim" }, `${verb} `), ...links)
}

function linksOf(links) {
  if (!links.length) return h("p", { class: "dim" }, "This module says nothing of its links")
  const rows = links.map(link => [
    link.name, h("span", { class: link.up ? null : "bad" }, link.up ? "up" : "down"), count(link.waiting),
    fixed(link.sent), fixed(link.received), kilobytes(link.bytes_sent), kilobytes(link.bytes_received),
    counters(link.lost, "bad"), counters(link.faults, "warn"),
  ])
  return plainTable("Links", ["Link", "State", "Waiting", "Out 1/s", "In 1/s", "Out kB/s", "In kB/s", "Lost", "Faults"], rows,
    { numbers: [2, 3, 4, 5, 6] })
}

function counters(found, tone) {
  if (!found) return UNKNOWN
  const known = Object.entries(found).filter(([, size]) => size)
  return known.length ? h("span", { class: tone }, known.map(([reason, size]) => `${reason} ${size}`).join(", ")) : "0"
}
