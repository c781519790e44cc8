// The events of a recording as a list: all that the track has as marks, for readers of screens and for search.

import { button, field, filterBox, h, setText } from "./dom.js"
import { count, plural } from "./format.js"

export const BAD_KINDS = new Set(["missed", "late", "overdue", "lost", "degraded", "recorder"])
const SHOWN = 200

// Return seconds as 1:02:03.4, as long as they need.
export function elapsed(seconds, decimals = 1) {
  const whole = Math.floor(seconds)
  const two = value => String(value).padStart(2, "0")
  const hours = Math.floor(whole / 3600)
  const minutes = Math.floor(whole / 60) % 60
  const parts = Math.floor((seconds - whole) * 10 ** decimals + 1e-6) // never more than has passed
  const fraction = decimals ? `.${String(parts).padStart(decimals, "0")}` : ""
  const rest = `${two(whole % 60)}${fraction}`
  return hours ? `${hours}:${two(minutes)}:${rest}` : `${minutes}:${rest}`
}

export class EventList {
  #timeline
  #filter = ""
  #sorted = []
  #known = 0

  constructor(timeline) {
    this.#timeline = timeline
    this.toggle = button("Events", () => this.#toggle(), { class: "quiet", "aria-expanded": "false" })
    this.kind = h("select", { onchange: () => this.#draw() }, h("option", { value: "" }, "all kinds"))
    this.body = h("tbody")
    this.note = h("p", { class: "dim" })
    const head = ["Time", "Kind", "About", "What", "Count"].map(text => h("th", { scope: "col" }, text))
    const filter = filterBox("Filter the events", text => {
      this.#filter = text.toLowerCase()
      this.#draw()
    })
    delete filter.dataset.filter // "/" belongs to the view
    filter.removeAttribute("aria-keyshortcuts")
    this.element = h(
      "section", { class: "timeline-events", "aria-label": "Events of the recording", hidden: true },
      h("div", { class: "timeline-tools" }, field("Kind", this.kind, { hidden: true }), filter, this.note,
        h("div", { class: "timeline-right" }, button("Close", () => this.#toggle(), { class: "quiet" }))),
      h("div", { class: "timeline-table", tabindex: 0, role: "region", "aria-label": "Table of events" },
        h("table", { "aria-label": "Events" }, h("thead", {}, h("tr", {}, head)), this.body)),
    )
  }

  // Enter what was found since.
  update() {
    const { events } = this.#timeline.marks
    if (events.length === this.#known) return
    this.#known = events.length
    this.#sorted = [...events].sort((one, other) => one.time - other.time)
    setText(this.toggle, plural(events.length, "event"))
    this.#offerKinds()
    if (!this.element.hidden) this.#draw()
  }

  // Seek to the next event, or to the one before.
  step(direction) {
    const { time } = this.#timeline
    const found = direction > 0
      ? this.#sorted.find(each => each.time > time + 1e-6)
      : this.#sorted.findLast(each => each.time < time - 1e-6)
    if (found) this.#timeline.seek(found.time)
  }

  #toggle() {
    this.element.hidden = !this.element.hidden
    this.toggle.setAttribute("aria-expanded", String(!this.element.hidden))
    if (this.element.hidden) this.toggle.focus()
    else this.#draw()
  }

  #offerKinds() {
    const known = new Set([...this.kind.options].map(each => each.value))
    const kinds = [...new Set(this.#sorted.map(each => each.kind))].filter(each => !known.has(each))
    this.kind.append(...kinds.sort().map(each => h("option", { value: each }, each)))
  }

  #draw() {
    const found = this.#sorted.filter(each => this.#matches(each))
    const first = Math.max(0, found.findIndex(each => each.time >= this.#timeline.time) - SHOWN / 2)
    const shown = found.length <= SHOWN ? found : found.slice(first, first + SHOWN)
    this.body.replaceChildren(...shown.map(each => this.#row(each)))
    setText(this.note, found.length > shown.length
      ? `${shown.length} of ${found.length}, around the time that is shown`
      : plural(found.length, "event"))
  }

  #matches({ kind, about, text }) {
    if (this.kind.value && kind !== this.kind.value) return false
    return !this.#filter || `${kind} ${about} ${text}`.toLowerCase().includes(this.#filter)
  }

  #row(event) {
    const { start } = this.#timeline
    const seek = button(elapsed(event.time - start, 3), () => this.#timeline.seek(event.time), { class: "quiet" })
    return h("tr", {},
      h("td", { class: "number" }, seek),
      h("td", { class: BAD_KINDS.has(event.kind) ? "bad" : null }, event.kind),
      h("td", {}, event.about),
      h("td", { class: "text" }, event.text),
      h("td", { class: "number" }, count(event.count)))
  }
}
