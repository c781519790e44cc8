// One RTCAN bus: its load by topic, against what is reserved for slots.

import { kindClass, kindName, LoadBar } from "./bus_load.js"
import { h, setText } from "./dom.js"
import { count, fixed, milliseconds, percent } from "./format.js"
import { LiveTable } from "./table.js"

const COLUMNS = [
  { id: "topic", title: "Topic", value: nameOf, draw: drawName },
  { id: "kind", title: "Kind", value: row => kindName(row.kind), tone: () => "dim" },
  { id: "module", title: "Module", level: 2, value: row => row.module || null },
  { id: "slots", title: "Slots", number: true, level: 2, hint: "Slots of the cycle that are reserved for it",
    value: row => row.slots ?? null },
  { id: "frames", title: "Frames", unit: "1/s", number: true, value: row => row.frames, text: row => fixed(row.frames, 0) },
  { id: "share", title: "Load", unit: "%", number: true, value: row => row.share, text: row => percent(row.share, 2) },
]

function nameOf(row) {
  return row.topic || kindName(row.kind)
}

function drawName(cell, row) {
  const swatch = cell.querySelector(".swatch") ?? cell.appendChild(h("span", { "aria-hidden": "true" }))
  swatch.className = `swatch ${kindClass(row.kind)}`
  const name = cell.querySelector(".bus-topic") ?? cell.appendChild(h("span", { class: "bus-topic" }))
  setText(name, nameOf(row))
}

export class BusCard {
  #name = h("h3", {})
  #load = h("strong")
  #facts = h("span", { class: "dim" })
  #bar = new LoadBar()
  #table = new LiveTable({
    id: "bus", caption: "Load of the bus by topic", columns: COLUMNS, key: row => `${row.kind} ${row.topic} ${row.module}`,
    sort: "-share", empty: "The bus has not said what its topics take",
  })
  #shown = null

  constructor() {
    const details = h("details", {}, h("summary", {}, "Load by topic"), this.#table.element)
    details.open = matchMedia("(min-width: 721px)").matches
    this.element = h("article", { class: "bus" },
      h("div", { class: "head" }, this.#name, this.#load, this.#facts), this.#bar.element, details)
  }

  update(bus) {
    if (bus === this.#shown) return
    this.#shown = bus
    setText(this.#name, bus.name)
    setText(this.#load, `${percent(bus.share)} % used`)
    setText(this.#facts, facts(bus))
    this.#bar.update(bus)
    const slots = new Map((bus.slots ?? []).map(each => [`${each.topic} ${each.module}`, each.slots.length]))
    this.#table.update((bus.topics ?? []).map(row => ({ ...row, slots: slots.get(`${row.topic} ${row.module}`) })))
  }
}

function facts(bus) {
  const known = [
    bus.reserved === undefined ? "" : `${percent(bus.reserved)} % reserved for slots`,
    bus.free_used === undefined ? "" : `${percent(bus.free_used)} % of the rest used`,
    bus.frames === undefined ? "" : `${fixed(bus.frames, 0)} frames/s`,
    bus.errors === undefined ? "" : `${count(bus.errors)} errors`,
    bus.slots_in_cycle ? `${bus.slots_in_cycle} slots in ${milliseconds(bus.cycle, 1)} ms` : "",
    bus.master ? `master ${bus.master}` : "",
  ]
  return known.filter(Boolean).join(" · ")
}
