// The time of a recording, below all views: what happened and when, where the page is in it, and play. Only pages of a
// recording load this.

import { attempt, toast } from "./dialogs.js"
import { button, field, h, setText } from "./dom.js"
import { clock, plural } from "./format.js"
import { elapsed, EventList } from "./timeline_events.js"
import { Track } from "./timeline_track.js"

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10, 30, 100]
const NS = 1e9

export function timelineOf(app) {
  document.head.append(h("link", { rel: "stylesheet", href: "timeline.css" }))
  return new Timeline(app)
}

class Timeline {
  start = 0 // s, UTC, as all times here
  end = 0
  time = 0
  playing = false
  share = 0
  marks = { events: [], misses: [], gaps: [], step: 1 }
  #app
  #wanted = null
  #asking = false

  constructor(app) {
    this.#app = app
    this.#build()
    const { connection } = app
    connection.addEventListener("hello", () => this.#begin())
    connection.addEventListener("clock", event => this.#follow(event.detail))
    connection.addEventListener("timeline", event => this.#learn(event.detail))
    this.#begin()
  }

  // Go to a time (s); of many quick moves the last one counts.
  seek(seconds) {
    this.time = Math.min(Math.max(seconds, this.start), this.end)
    this.#wanted = this.time
    this.#show()
    if (!this.#asking) this.#seekOn()
  }

  async #seekOn() {
    this.#asking = true
    while (this.#wanted !== null) {
      const time = Math.round(this.#wanted * NS)
      this.#wanted = null
      await attempt(this.#app.connection.request("seek", { time }))
    }
    this.#asking = false
  }

  play(rate) {
    return attempt(this.#app.connection.request("play", { rate }))
  }

  toggle() {
    return this.play(this.playing ? 0 : Number(this.rate.value))
  }

  #build() {
    this.button = button("Play", () => this.toggle(), {
      class: "play", "aria-keyshortcuts": "p", title: "Play or pause (p)", dataset: { pause: "" },
    })
    this.rate = h("select", { onchange: () => this.playing && this.play(Number(this.rate.value)) }, RATES.map(
      rate => h("option", { value: rate, selected: rate === 1 }, `${rate}×`),
    ))
    this.position = h("p", { class: "position" })
    this.reading = h("p", { class: "reading dim", role: "status" })
    this.problem = button("", () => this.#explain(), { class: "quiet warn", hidden: true })
    this.track = new Track(this)
    this.events = new EventList(this)
    const tools = h(
      "div", { class: "timeline-tools" },
      this.button, field("Rate", this.rate, { hidden: true }), this.position, this.reading, this.problem,
      h("div", { class: "timeline-right" }, this.events.toggle, ...this.track.buttons),
    )
    const footer = document.getElementById("timeline")
    footer.setAttribute("aria-label", "Time line of the recording")
    footer.replaceChildren(this.events.element, tools, this.track.element)
    footer.hidden = false
  }

  async #begin() {
    this.marks = { events: [], misses: [], gaps: [], step: 1 }
    const found = await attempt(this.#app.connection.request("timeline"))
    if (!found) return
    this.start = found.start / NS
    this.end = found.end / NS
    this.time = this.time >= this.start && this.time <= this.end ? this.time : this.end
    this.marks.step = found.step / NS
    this.#problems = found.problems
    this.track.reset()
    this.#show()
  }

  #problems = []
  #damaged = 0
  #leftOut = 0

  #follow({ time, playing, rate }) {
    this.playing = playing
    if (this.#wanted === null && !this.track.dragging) this.time = time / NS
    setText(this.button, playing ? "Pause" : "Play")
    if (playing) this.rate.value = String(rate)
    if (playing) this.track.keepInView(this.time)
    this.#show()
  }

  #learn({ share, events, misses, gaps, left_out, damaged }) {
    const { marks } = this
    for (const each of events) marks.events.push({ ...each, time: each.time / NS, until: each.until / NS })
    for (const [topic, kind, step, count] of misses) marks.misses.push({ topic, kind, step, count })
    for (const [topic, start, end] of gaps) marks.gaps.push({ topic, start: start / NS, end: end / NS })
    this.share = share
    this.#leftOut = left_out
    this.#damaged = damaged
    this.events.update()
    this.#show()
  }

  #show() {
    const zoomed = this.end - this.start < 60 ? 2 : 1
    setText(this.position, `${elapsed(this.time - this.start, zoomed)} / ${elapsed(this.end - this.start, zoomed)}`)
    this.position.title = `${new Date(this.time * 1000).toLocaleDateString()} ${clock(this.time, 3)}`
    setText(this.reading, this.share < 1 ? `reading ${Math.floor(100 * this.share)} %` : "")
    const sum = this.#problems.length + this.#damaged + this.#leftOut
    this.problem.hidden = sum === 0
    setText(this.problem, this.#problems.length || this.#damaged ? "damaged file" : "not all shown")
    this.track.draw()
  }

  #explain() {
    for (const each of this.#problems) toast(each, "bad")
    if (this.#damaged) toast(`${plural(this.#damaged, "chunk")} of the file can't be read: r2p bag recover`, "bad")
    if (this.#leftOut) toast(`${this.#leftOut} further events are not in the time line: r2p bag events has all`, "bad")
  }
}
