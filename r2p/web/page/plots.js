// The plots: any fields of any topics, several in each plot, over one window of time. The address keeps what is plotted:
// #/plots/odometry.pose.x+odometry.pose.y,battery.voltage;window=30 has two plots of 30 s.

import { button, download, field, h, setText } from "./dom.js"
import { FieldCatalog, pickFields } from "./field_picker.js"
import { clock } from "./format.js"
import { Plot } from "./plot.js"
import { csv } from "./series.js"
import { Streams } from "./streams.js"
import { TimeWindow, WIDTHS } from "./time_window.js"

const LABELS = 100 // ms between values that are read
const SETTLED = 150 // ms after which a recording is asked for what is shown
const ZOOM = 0.7
const PAN = 0.1 // of the window

export const plots = {
  id: "plots",
  title: "Plots",
  keys: [
    ["← →", "move the window"],
    ["+ -", "zoom"],
    ["shift ← →", "move the cursor, which shows values"],
    ["l or Home", "the newest values; all of a recording"],
    ["a", "add a plot"],
    ["drag, wheel, pinch", "move and zoom; double click: back to the newest"],
  ],
  create: app => new PlotsView(app),
}

class PlotsView {
  #app
  #streams
  #catalog
  #window = new TimeWindow()
  #plots = []
  #shown = false
  #frame = 0
  #labelled = 0
  #cursor = null
  #whole = null // of a recording: {start, end}
  #fits = true // the window is all of the recording
  #settling = 0
  #list = h("div", { class: "plot-list fill" })
  #span = h("p", { class: "dim nowrap mono" })
  #pause = button("Pause", () => this.#pauseOrFollow(),
    { "aria-pressed": "false", "aria-keyshortcuts": "p", title: "Pause or resume (p)", dataset: { pause: "" } })
  #width
  #empty

  constructor(app) {
    this.#app = app
    this.#streams = new Streams(app)
    this.#catalog = new FieldCatalog(app.connection)
    this.#width = h("select", { onchange: () => this.#setWidth() })
    this.#empty = h("div", { class: "empty" },
      h("p", {}, "Nothing is plotted yet."), button("Choose fields", () => this.#addPlot(), { class: "primary" }))
    this.element = h("section", { class: "view full" }, this.#bar(), this.#empty, this.#list)
    this.#window.addEventListener("change", () => this.#windowChanged())
    this.#streams.addEventListener("points", event => this.#heard(event.detail))
    app.connection.addEventListener("clock", event => this.#mark(event.detail.time / 1e9))
    app.connection.addEventListener("hello", event => {
      this.#pause.hidden = event.detail.recording
    })
    document.addEventListener("theme", () => this.#plots.forEach(plot => plot.recolor()))
    this.#nameWidths()
  }

  show(argument) {
    if (argument || !this.#plots.length) this.#open(argument)
    else this.#keepAddress()
    this.#shown = true
    this.#animate()
  }

  hide() {
    this.#shown = false
    cancelAnimationFrame(this.#frame)
  }

  key(event) {
    const act = this.#keys(event.shiftKey && event.key.startsWith("Arrow") ? `shift ${event.key}` : event.key)
    if (!act || event.target.closest("select, input")) return false
    act()
    return true
  }

  #keys(key) {
    const follow = () => this.#reset()
    return {
      ArrowLeft: () => this.#window.pan(-PAN * this.#window.width),
      ArrowRight: () => this.#window.pan(PAN * this.#window.width),
      "shift ArrowLeft": () => this.#moveCursor(-1),
      "shift ArrowRight": () => this.#moveCursor(1),
      "+": () => this.#window.zoom(ZOOM, 0.5),
      "=": () => this.#window.zoom(ZOOM, 0.5),
      "-": () => this.#window.zoom(1 / ZOOM, 0.5),
      Home: follow,
      l: follow,
      a: () => this.#addPlot(),
      Escape: this.#cursor === null ? null : () => this.#point(null),
    }[key]
  }

  #bar() {
    return h("div", { class: "bar" },
      h("h2", {}, "Plots"),
      button("Add plot", () => this.#addPlot(), { title: "Add a plot (a)" }),
      this.#pause,
      field("Window", this.#width),
      button("−", () => this.#window.zoom(1 / ZOOM, 0.5), { class: "quiet", "aria-label": "Zoom out", title: "Zoom out (-)" }),
      button("+", () => this.#window.zoom(ZOOM, 0.5), { class: "quiet", "aria-label": "Zoom in", title: "Zoom in (+)" }),
      h("span", { class: "space" }), this.#span)
  }

  // Which plots there are

  #open(argument) {
    const [, text, width] = argument.match(/^(.*?)(?:;window=([\d.]+))?$/) ?? []
    if (Number(width) > 0) this.#window.setWidth(Number(width))
    const wanted = (text ?? "").split(",").map(each => each.split("+").filter(name => name.includes("."))).filter(each => each.length)
    if (JSON.stringify(wanted) === JSON.stringify(this.#plots.map(plot => plot.fields.map(each => each.name)))) return
    for (const plot of this.#plots.splice(0)) this.#drop(plot)
    for (const names of wanted) this.#create(names)
    this.#changed()
  }

  #create(names) {
    const plot = new Plot(this.#streams, this.#window, {
      add: () => this.#choose(plot),
      save: () => this.#save(plot),
      remove: () => this.#remove(plot),
      changed: () => this.#changed(),
      point: time => this.#point(time),
      reset: () => this.#reset(),
      tap: time => this.#tap(time),
    })
    for (const name of names) plot.add(name)
    this.#plots.push(plot)
    this.#list.append(plot.element)
    return plot
  }

  #remove(plot) {
    this.#plots = this.#plots.filter(each => each !== plot)
    this.#drop(plot)
    this.#changed()
  }

  #drop(plot) {
    plot.close()
    plot.element.remove()
  }

  #addPlot() {
    this.#choose(this.#create([]))
    this.#changed()
  }

  #choose(plot) {
    const chosen = () => plot.fields.map(each => each.name)
    const toggle = (name, wanted) => {
      if (wanted) plot.add(name)
      else plot.remove(name)
      this.#changed()
    }
    const onclose = () => plot.fields.length || this.#remove(plot)
    pickFields({ app: this.#app, catalog: this.#catalog, chosen, toggle, onclose })
  }

  #changed() {
    this.#empty.hidden = this.#plots.length > 0
    this.#list.hidden = !this.#plots.length
    if (this.#app.hello?.recording) this.#look()
    this.#keepAddress()
  }

  #keepAddress() {
    const names = this.#plots.map(plot => plot.fields.map(each => each.name).join("+")).filter(Boolean).join(",")
    const width = this.#window.live && this.#window.width !== 10 ? `;window=${this.#window.width}` : ""
    this.#app.plotted = names
    if (this.#shown || location.hash.startsWith("#/plots")) this.#app.rename("plots", names && names + width)
  }

  // The window of time

  #pauseOrFollow() {
    if (this.#window.live) this.#window.pause()
    else this.#window.follow()
  }

  #reset() {
    if (this.#whole) this.#fit()
    else this.#window.follow()
  }

  #setWidth() {
    this.#window.setWidth(Number(this.#width.value))
    this.#keepAddress()
  }

  #windowChanged() {
    const { live } = this.#window
    this.#pause.setAttribute("aria-pressed", !live)
    setText(this.#pause, live ? "Pause" : "Resume")
    this.#nameWidths()
    const range = this.#window.range()
    this.#fits = this.#whole === null || range.end === this.#whole.end && this.#window.width === range.end - this.#whole.start
    if (this.#app.hello?.recording) this.#look()
  }

  #nameWidths() {
    const { width } = this.#window
    const widths = WIDTHS.includes(width) ? WIDTHS : [...WIDTHS, width].sort((one, other) => one - other)
    this.#width.replaceChildren(...widths.map(each => h("option", { value: each }, `${Number(each.toPrecision(3))} s`)))
    this.#width.value = width
  }

  // A recording is asked for what is shown, once the window rests.
  #look() {
    clearTimeout(this.#settling)
    this.#settling = setTimeout(() => {
      const part = this.#fits || !this.#whole ? {} : this.#window.range()
      this.#streams.look({ ...part, points: 2 * Math.max(500, this.#list.clientWidth) })
    }, SETTLED)
  }

  #heard(numbers) {
    this.#app.stats.points += numbers
    if (!numbers) return
    const points = this.#streams.all().filter(series => series.length)
    if (!this.#app.hello?.recording) return this.#window.heard(Math.max(...points.map(series => series.last)))
    return this.#learnWhole(points)
  }

  // The first points of a recording are coarse: more of them may begin earlier and end later.
  #learnWhole(points) {
    const { start, end } = this.#whole ?? { start: Infinity, end: -Infinity }
    const first = Math.min(start, ...points.map(series => series.times[0]))
    const last = Math.max(end, ...points.map(series => series.last))
    if (first === start && last === end) return
    this.#whole = { start: first, end: last }
    if (this.#fits) this.#fit()
  }

  #fit() {
    this.#window.show(this.#whole.start, this.#whole.end)
  }

  #mark(time) {
    for (const plot of this.#plots) plot.mark(time)
  }

  #tap(time) {
    this.#point(time)
    if (this.#app.hello?.recording)
      this.#app.connection.request("seek", { time: Math.round(time * 1e9) }).catch(() => {})
  }

  #point(time) {
    this.#cursor = time
    for (const plot of this.#plots) plot.point(time)
    this.#labelled = 0
  }

  #moveCursor(direction) {
    const range = this.#window.range()
    if (!range) return
    if (this.#window.live) this.#window.pause()
    const at = (this.#cursor ?? (range.start + range.end) / 2) + direction * this.#window.width / 100
    this.#point(Math.min(range.end, Math.max(range.start, at)))
  }

  // Drawing: once for each frame of the screen, and only what has changed

  #animate() {
    cancelAnimationFrame(this.#frame)
    if (!this.#shown) return
    this.#frame = requestAnimationFrame(() => this.#animate())
    const range = this.#window.range()
    if (range) this.#draw(range)
    if (performance.now() - this.#labelled > LABELS) this.#label(range)
  }

  #draw(range) {
    const drawn = this.#plots.filter(plot => plot.draw(range)).length
    this.#app.stats.redraws += drawn
    if (drawn) this.#app.stats.frames++
  }

  #label(range) {
    this.#labelled = performance.now()
    for (const plot of this.#plots) plot.label(range)
    if (!range || !this.#plots.length) return setText(this.#span, "")
    const decimals = this.#window.width < 10 ? 3 : 0
    setText(this.#span, this.#cursor === null
      ? `${clock(range.start, decimals)} – ${clock(range.end, decimals)}`
      : clock(this.#cursor, 3))
  }

  #save(plot) {
    const range = this.#window.range()
    if (!range) return
    const name = `${plot.fields[0]?.name.replaceAll(/[^\w.-]/g, "_") ?? "plot"}.csv`
    download(name, csv(plot.fields, range.start, range.end), "text/csv")
  }
}
