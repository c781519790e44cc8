// The slots of RTCAN buses: who owns which, which are free or reserved and not used, and the load against the budget.

import { kindName, LoadBar, sharesOf } from "./bus_load.js"
import { h, pauseButton, place, setText } from "./dom.js"
import { count, fixed, milliseconds, percent, plural, UNKNOWN } from "./format.js"
import { LiveTable } from "./table.js"

const COLOURS = 8
const FREE_USED_MAX = 0.8 // of the free slots; beyond it events wait long (r2p.msg.BusTraffic)

export const slots = {
  id: "slots",
  title: "Slots",
  create(app) {
    const buses = h("div", { class: "buses" })
    const empty = h("div", { class: "empty" },
      h("p", {}, "No RTCAN bus is known yet."),
      h("p", {}, "A bus is shown where this tool is on it, or a module of it publishes bus_load and bus_slots: " +
        "the first figures take up to 3 s."))
    const drawn = new Map()
    let paused = false
    const draw = () => {
      if (paused) return
      empty.hidden = app.store.buses.size > 0
      for (const [name, bus] of app.store.buses) {
        if (!drawn.has(name)) drawn.set(name, new BusPicture(name))
        drawn.get(name).update(bus)
      }
      for (const name of drawn.keys()) if (!app.store.buses.has(name)) drawn.delete(name)
      place(buses, [...drawn.keys()].sort().map(name => drawn.get(name).element))
    }
    return {
      element: h("section", { class: "view" },
        h("div", { class: "bar" }, h("h2", {}, "Slots"), h("span", { class: "space" }), pauseButton(value => {
          paused = value
          draw()
        })), empty, buses),
      show() {
        app.store.addEventListener("change", draw)
        draw()
      },
      hide() {
        app.store.removeEventListener("change", draw)
      },
    }
  },
}

// Return the owner of each slot of a cycle: {topic, module, state: "sync", "owned", "reserved" or "free"}.
function cellsOf(bus) {
  const free = { state: "free", topic: "", module: "", others: 0 }
  const cells = Array(bus.slots_in_cycle ?? 0).fill(free)
  for (const owner of bus.slots ?? []) {
    for (const slot of owner.slots ?? []) {
      if (!cells[slot]) continue
      const others = cells[slot].state === "owned" ? cells[slot].others + 1 : 0 // long periods share a slot
      cells[slot] = { state: stateOf(slot, owner), topic: owner.topic ?? "", module: owner.module ?? "", others }
    }
  }
  return cells
}

function stateOf(slot, owner) {
  if (slot === 0) return "sync"
  return owner.topic ? "owned" : "reserved"
}

// Return a row for each topic of each module on a bus: what it takes, and what is reserved for it.
function rowsOf(bus) {
  const rows = new Map()
  for (const each of bus.topics ?? []) {
    const isOfUsers = !["sync", "management"].includes(each.kind)
    const topic = isOfUsers ? each.topic : ""
    const key = `${each.module} ${topic || each.kind}`
    const kind = kindName(each.kind)
    rows.set(key, { key, kind, topic, module: each.module, share: each.share, frames: each.frames })
  }
  for (const { topic, module, slots: owned } of bus.slots ?? []) {
    if (!topic || !owned?.length) continue
    const isSync = owned[0] === 0
    const key = `${module} ${isSync ? "sync" : topic}`
    const row = rows.get(key) ?? { key, kind: kindName(isSync ? "sync" : "hrt"), topic: isSync ? "" : topic, module }
    rows.set(key, { ...row, slots: owned, reserved: bus.slots_in_cycle ? owned.length / bus.slots_in_cycle : null })
  }
  return [...rows.values()]
}

// Give each owner a colour that stays: by the order in which their names are first seen.
class Colours {
  #numbers = new Map()

  of(owner) {
    if (!this.#numbers.has(owner)) this.#numbers.set(owner, this.#numbers.size % COLOURS + 1)
    return this.#numbers.get(owner)
  }
}

const COLUMNS = colours => [
  { id: "topic", title: "Topic", value: row => row.topic || row.kind, draw: (cell, row) => {
    const owner = row.topic ? `owner-${colours.of(ownerOf(row))}` : "kind-sync"
    const swatch = h("span", { class: `swatch ${row.slots ? owner : "none"}` })
    cell.replaceChildren(swatch, row.topic || row.kind)
  } },
  { id: "module", title: "Module", value: row => row.module || null },
  { id: "kind", title: "Kind", level: 2, value: row => row.kind, tone: () => "dim" },
  { id: "slots", title: "Slots", number: true, value: row => row.slots?.length, text: row => count(row.slots?.length) },
  { id: "numbers", title: "Numbers", level: 4, value: row => row.slots?.[0], text: row => ranges(row.slots ?? []) },
  { id: "reserved", title: "Reserved", unit: "%", number: true, level: 2, value: row => row.reserved,
    text: row => percent(row.reserved), hint: "Share of the cycle that its slots take" },
  { id: "share", title: "Used", unit: "%", number: true, value: row => row.share, text: row => percent(row.share, 2),
    hint: "Share of the time that its frames take, stuff bits included" },
  { id: "frames", title: "Frames", unit: "1/s", number: true, level: 2, value: row => row.frames,
    text: row => fixed(row.frames, 0) },
]

// Return numbers as ranges: "1-3, 17".
export function ranges(numbers) {
  const sorted = [...numbers].sort((one, other) => one - other)
  const found = []
  for (const number of sorted) {
    const last = found.at(-1)
    if (last && last[1] === number - 1) last[1] = number
    else found.push([number, number])
  }
  return found.map(([first, last]) => (first === last ? String(first) : `${first}-${last}`)).join(", ")
}

const ownerOf = ({ module, topic }) => `${module} ${topic}`

class BusPicture {
  #colours = new Colours()
  #facts = h("p", { class: "dim" })
  #cells = h("ol", { class: "slots" })
  #bar = new LoadBar()
  #load = h("p", { class: "dim" })
  #hint = h("p", { class: "hint", hidden: true },
    "The slots of this bus are not known: no module of it publishes bus_slots.")
  #warning = h("p", { class: "warn", role: "status" })
  #said = h("p", { class: "slot-said", "aria-hidden": "true" })
  #table
  #last = null

  constructor(name) {
    this.#table = new LiveTable({
      id: "slots", caption: `Topics on ${name}`, columns: COLUMNS(this.#colours), key: row => row.key, sort: "-share",
      empty: "No figures of topics on this bus",
    })
    this.#cells.setAttribute("aria-label", `Slots of the cycle of ${name}`)
    this.element = h("section", { class: "panel bus", dataset: { bus: name }, "aria-label": `Bus ${name}` },
      h("div", { class: "head" }, h("h2", {}, name), this.#facts), this.#bar.element, this.#load, this.#warning,
      this.#hint, this.#cells, this.#said, key(), this.#table.element)
    for (const event of ["pointerover", "focusin"]) this.#cells.addEventListener(event, each => this.#say(each.target))
    this.#cells.addEventListener("pointerleave", () => this.#say(null))
  }

  update(bus) {
    if (bus === this.#last) return
    this.#last = bus
    const cells = cellsOf(bus)
    setText(this.#facts, factsOf(bus))
    this.#drawLoad(bus)
    this.#hint.hidden = cells.length > 0
    this.#drawCells(cells)
    this.#table.update(rowsOf(bus))
    Object.assign(this.element.dataset, {
      slots: cells.length, free: cells.filter(cell => cell.state === "free").length,
    })
  }

  #drawLoad(bus) {
    this.#bar.update(bus)
    const parts = sharesOf(bus).map(([kind, share]) => `${kindName(kind)} ${percent(share)} %`)
    setText(this.#load, [
      `Load ${percent(bus.share)} %`, `reserved for slots ${percent(bus.reserved)} %`,
      `free slots used ${percent(bus.free_used)} %`, ...parts,
    ].join(" · "))
    setText(this.#warning, [
      bus.free_used > FREE_USED_MAX ? "Events wait long: over 80 % of the free slots are used." : "",
      bus.errors ? `${plural(bus.errors, "error")} on the bus.` : "",
    ].join(" ").trim())
  }

  #drawCells(cells) {
    const shown = JSON.stringify(cells)
    if (shown === this.#cells.dataset.shown) return
    this.#cells.dataset.shown = shown
    this.#cells.replaceChildren(...cells.map((cell, index) => {
      const owner = cell.state === "owned" ? `owner-${this.#colours.of(ownerOf(cell))}` : ""
      const item = h("li", { class: `slot ${cell.state} ${owner}`, title: nameOf(cell, index), dataset: {
        slot: index, owner: ownerOf(cell),
      } }, h("span", { "aria-hidden": "true" }, index), h("span", { class: "sr-only" }, nameOf(cell, index)))
      return item
    }))
  }

  // Name the slot below the pointer, and mark the others of its owner.
  #say(target) {
    const slot = target?.closest?.(".slot")
    for (const each of this.#cells.children) {
      const same = slot?.classList.contains("owned") && each.dataset.owner === slot.dataset.owner
      each.classList.toggle("same", Boolean(same))
    }
    setText(this.#said, slot?.title ?? "")
  }
}

function factsOf(bus) {
  return [
    bus.master ? `master ${bus.master}` : "master not known",
    bus.cycle ? `cycle ${milliseconds(bus.cycle)} ms` : `cycle ${UNKNOWN}`,
    bus.slots_in_cycle ? plural(bus.slots_in_cycle, "slot") : `slots ${UNKNOWN}`,
    bus.cycle && bus.slots_in_cycle ? `${(bus.cycle / bus.slots_in_cycle * 1e6).toFixed(0)} µs each` : "",
    `${fixed(bus.frames, 0)} frames/s`,
  ].filter(Boolean).join(" · ")
}

function nameOf(cell, index) {
  const owner = `${cell.module}: ${cell.topic}${cell.others ? `, and ${plural(cell.others, "other")} in turn` : ""}`
  const text = {
    sync: `sync of the master${cell.module ? ` ${cell.module}` : ""}`,
    owned: owner,
    reserved: "reserved, not used: no subscriber, or the owner is gone",
    free: "free, for events",
  }[cell.state]
  return `Slot ${index}: ${text}`
}

function key() {
  const item = (state, text) => (
    h("span", { class: "key-item" }, h("span", { class: `slot ${state}`, "aria-hidden": "true" }), text))
  return h("p", { class: "slot-key dim" }, item("sync", "sync"), item("owned owner-1", "owned, a colour each"),
    item("reserved", "reserved, not used"), item("free", "free"))
}
