// One plot: a canvas with its fields, their values, and what mouse, touch and keyboard do to the window of time.

import { button, color, h, setText } from "./dom.js"
import { clock, number } from "./format.js"
import { Steps } from "./series.js"

const COLORS = 8
const FONT = "11px Inter, system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
const FINE = 4 // fields beyond which lines are of one pixel: a browser without a GPU draws these five times as fast
const WHEEL = 1.0015 // zoom for each pixel of the wheel

export class Plot {
  fields = []
  #streams
  #window
  #acts
  #chart = null
  #steps = []
  #stepSize = 0
  #data = [[]]
  #drawn = ""
  #canvas = h("div", { class: "plot-canvas", tabindex: "0", role: "group" })
  #legend = h("ul", { class: "legend" })
  #rows = new Map()
  #cursor = null // s, UTC
  #marker = null // s, UTC: where a recording is

  // `acts` has add(plot), save(plot), remove(plot), changed() and seek(time).
  constructor(streams, window_, acts) {
    this.#streams = streams
    this.#window = window_
    this.#acts = acts
    const bar = h("div", { class: "plot-bar" },
      button("Add field", () => acts.add(this), { class: "quiet" }),
      button("CSV", () => acts.save(this), { class: "quiet", title: "Save the points that are shown" }),
      button("×", () => acts.remove(this), { class: "quiet close", "aria-label": "Remove this plot" }))
    this.element = h("article", { class: "plot panel" }, this.#canvas, h("div", { class: "plot-side" }, bar, this.#legend))
    this.#listen()
  }

  add(name) {
    if (this.fields.some(field => field.name === name)) return
    const taken = new Set(this.fields.map(field => field.color))
    const free = Array.from({ length: COLORS }, (_, index) => index + 1).find(each => !taken.has(each))
    const stream = this.#streams.use(name)
    this.fields.push({ name, stream, series: stream.series, field: name, color: free ?? 1 + this.fields.length % COLORS })
    this.#rebuild()
  }

  remove(name) {
    this.fields = this.fields.filter(field => field.name !== name)
    this.#streams.release(name)
    this.#rebuild()
  }

  close() {
    for (const { name } of this.fields) this.#streams.release(name)
    this.fields = []
    this.#chart?.destroy()
    this.#chart = null
  }

  // Draw what the window shows now; return whether there was anything new to draw.
  draw(range) {
    const box = this.#canvas
    if (!box.clientWidth || !box.clientHeight || !this.fields.length) return false
    this.#chart ??= this.#create()
    const state = this.#state(range, box)
    if (state === this.#drawn) return false
    this.#drawn = state
    this.#fit(box)
    this.#collect(range)
    this.#chart.batch(() => {
      this.#chart.setData(this.#data, false)
      this.#chart.setScale("x", { min: range.start, max: range.end })
    })
    return true
  }

  // Say the values: at the cursor, or else the newest ones that are shown.
  label(range) {
    for (const { name, stream, series, field } of this.fields) {
      const { value, item } = this.#rows.get(name)
      const error = stream.errors.get(name)
      const at = this.#cursor ?? range?.end ?? Infinity
      setText(value, error ?? number(series.valueAt(field, at), 5))
      item.classList.toggle("failed", error !== undefined)
    }
  }

  // All plots show the values of the same time.
  point(time) {
    this.#cursor = time
    if (!this.#chart) return
    const left = time === null ? -10 : this.#chart.valToPos(time, "x")
    this.#chart.setCursor({ left, top: time === null ? -10 : 4 }, false)
  }

  mark(time) {
    this.#marker = time
    this.#drawn = ""
  }

  // The theme has changed.
  recolor() {
    this.#rebuild()
  }

  #state({ start, end }, box) {
    const moved = Math.round(2 * (start / (end - start)) * box.clientWidth) // half a pixel
    const points = this.fields.map(({ series }) => series.dropped + series.length + series.version)
    const news = this.#window.live ? points.join() : points.map((_, index) => this.#newsIn(index, end)).join()
    return `${moved} ${end - start} ${box.clientWidth} ${box.clientHeight} ${news}`
  }

  // Points behind the window change nothing in it.
  #newsIn(index, end) {
    const { series } = this.fields[index]
    return series.last <= end ? series.length + series.dropped : `${series.indexAt(end) + series.dropped} ${series.version}`
  }

  #fit(box) {
    const { width, height } = this.#chart
    if (width !== box.clientWidth || height !== box.clientHeight)
      this.#chart.setSize({ width: box.clientWidth, height: box.clientHeight })
  }

  #collect({ start, end }) {
    const pixels = Math.max(50, Math.round(this.#chart.bbox.width / devicePixelRatio))
    const step = (end - start) / pixels
    if (Math.abs(step - this.#stepSize) > 1e-9 * step) this.#resetSteps(step, pixels + 3)
    const from = Math.floor(start / this.#stepSize)
    const to = Math.min(Math.ceil(end / this.#stepSize), from + pixels + 2)
    const size = 2 * (to - from + 1)
    const times = this.#data[0]
    for (let at = 0; at < size; at++) times[at] = (from + (at + 0.5) / 2) * this.#stepSize
    this.#steps.forEach((steps, index) => steps.read(from, to, this.#data[index + 1]))
    for (const array of this.#data) array.length = size
  }

  #resetSteps(step, size) {
    this.#stepSize = step
    this.#steps = this.fields.map(({ series, field }) => new Steps(series, field, step, size))
    this.#data = [[], ...this.fields.map(() => [])]
  }

  #rebuild() {
    this.#chart?.destroy()
    this.#chart = null
    this.#drawn = ""
    this.#stepSize = 0
    this.#canvas.setAttribute("aria-label", this.fields.length
      ? `Plot of ${this.fields.map(field => field.name).join(", ")}. Its values are in the list that follows.`
      : "Empty plot")
    this.#rows = new Map(this.fields.map(field => [field.name, this.#row(field)]))
    this.#legend.replaceChildren(...[...this.#rows.values()].map(row => row.item))
  }

  #row({ name, color: index }) {
    const value = h("span", { class: "value" })
    const drop = button("×", () => {
      this.remove(name)
      this.#acts.changed()
    }, { class: "quiet close", "aria-label": `Remove ${name}` })
    const label = h("span", { class: "name", title: name }, name)
    const item = h("li", {}, h("span", { class: `line-sample series-${index}`, "aria-hidden": "true" }), label, value, drop)
    return { item, value }
  }

  #create() {
    const axis = { stroke: color("--dim"), font: FONT, grid: { stroke: color("--line"), width: 1 },
      ticks: { stroke: color("--line"), size: 4, width: 1 } }
    return new uPlot({
      width: this.#canvas.clientWidth,
      height: this.#canvas.clientHeight,
      padding: [8, 14, 0, 0],
      legend: { show: false },
      cursor: { drag: { x: false, y: false, setScale: false }, points: { size: 6 }, y: false },
      scales: { x: { time: true }, y: { range: padded } },
      axes: [
        { ...axis, size: 26, space: 80, values: (_, times, _axis, _space, step) => times.map(time => timeLabel(time, step)) },
        { ...axis, size: 58, space: 34 },
      ],
      series: [{}, ...this.fields.map(field => ({
        label: field.name, stroke: color(`--series-${field.color}`), width: this.fields.length > FINE ? 1 : 1.5, points: { size: 4 },
      }))],
      hooks: { draw: [chart => this.#drawMarker(chart)] },
    }, this.#empty(), this.#canvas)
  }

  #empty() {
    return [[], ...this.fields.map(() => [])]
  }

  #drawMarker(chart) {
    if (this.#marker === null) return
    const { left, top, width, height } = chart.bbox
    const x = Math.round(chart.valToPos(this.#marker, "x", true))
    if (x < left || x > left + width) return
    chart.ctx.fillStyle = color("--accent")
    chart.ctx.fillRect(x, top, Math.max(1, Math.round(devicePixelRatio)), height)
  }

  // Mouse, touch and keyboard

  #listen() {
    const box = this.#canvas
    const pointers = new Map()
    box.addEventListener("wheel", event => this.#wheel(event), { passive: false })
    box.addEventListener("pointerdown", event => this.#press(event, pointers))
    box.addEventListener("pointermove", event => this.#move(event, pointers))
    for (const name of ["pointerup", "pointercancel"])
      box.addEventListener(name, event => this.#release(event, pointers))
    box.addEventListener("pointerleave", () => this.#acts.point(null))
    box.addEventListener("dblclick", () => this.#acts.reset())
  }

  // Where an event is in the window: 0 to 1 from its start.
  #place(x) {
    const over = this.#chart?.over.getBoundingClientRect()
    return over ? (x - over.left) / over.width : 0.5
  }

  #wheel(event) {
    if (event.ctrlKey || !event.deltaY) return
    event.preventDefault()
    this.#window.zoom(WHEEL ** event.deltaY, this.#place(event.clientX))
  }

  #press(event, pointers) {
    if (event.button) return
    pointers.set(event.pointerId, { x: event.clientX, from: event.clientX })
    event.currentTarget.setPointerCapture(event.pointerId)
  }

  #move(event, pointers) {
    const range = this.#window.range()
    if (!range) return
    const at = range.start + this.#place(event.clientX) * (range.end - range.start)
    if (!pointers.size) return this.#acts.point(at)
    const pointer = pointers.get(event.pointerId)
    if (!pointer) return
    const before = [...pointers.values()].map(each => each.x)
    pointer.x = event.clientX
    if (pointers.size === 1) this.#drag(pointer, before[0])
    else this.#pinch(before, [...pointers.values()].map(each => each.x))
  }

  // A tap shows the values there; only what is dragged for some way moves the window.
  #drag(pointer, before) {
    pointer.dragged ||= Math.abs(pointer.x - pointer.from) > 4
    if (pointer.dragged) this.#window.pan((this.#place(before) - this.#place(pointer.x)) * this.#window.width)
  }

  #pinch([one, other], [oneNow, otherNow]) {
    const apart = Math.abs(one - other)
    const apartNow = Math.abs(oneNow - otherNow)
    const middle = this.#place((oneNow + otherNow) / 2)
    if (apart > 5 && apartNow > 5) this.#window.zoom(apart / apartNow, middle)
    if (!this.#window.live) this.#window.pan((this.#place((one + other) / 2) - middle) * this.#window.width)
  }

  #release(event, pointers) {
    const pointer = pointers.get(event.pointerId)
    pointers.delete(event.pointerId)
    if (!pointer || pointer.dragged || event.type === "pointercancel") return
    const range = this.#window.range()
    if (range) this.#acts.tap(range.start + this.#place(event.clientX) * (range.end - range.start))
  }
}

function padded(_chart, low, high) {
  if (low === null || high === null) return [-1, 1]
  const room = high > low ? 0.08 * (high - low) : 0.1 * Math.abs(high) || 1
  return [low - room, high + room]
}

function timeLabel(time, step) {
  return clock(time, step >= 1 ? 0 : step >= 0.001 ? 3 : 6)
}
