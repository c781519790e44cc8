// The map: the positions and paths of robots, from topics with a pose.

import { attempt, openDialog, toast } from "./dialogs.js"
import { button, color, field, h, memory, oncePerFrame, setText } from "./dom.js"
import { fixed, UNKNOWN } from "./format.js"
import { PanZoom } from "./pan_zoom.js"
import { boundsOf, gridStep, lengthText, mayHavePose, poseOf, readerOf, Trail } from "./poses.js"

const TRAILS = [[10, "10 s"], [60, "1 min"], [600, "10 min"], [0, "all"]]
const SHOWN_MAX = 8 // topics at a time
const START = { x: 0, y: 0, scale: 60 } // centre in m, px per m
const SCALE_MIN = 1e-4
const SCALE_MAX = 1e5
const SIZE_MIN = 0.5 // m that a fitted map shows at least
const ROBOT = 11 // px
const AGAIN = 5_000 // ms, after which a topic that could not be described is asked for again
const STREAMS = 0x8000 // the first one of maps; plots number theirs from 0

export const map = {
  id: "map",
  title: "Map",
  keys: [["← → ↑ ↓", "move the map"], ["+ -", "zoom"], ["f", "fit all of it"], ["c", "clear the trails"]],
  create: app => new MapView(app),
}

class MapView {
  #app
  #topics = new Map() // by name: {name, pose, trail, stream, row, colour} of those that have a pose
  #asked = new Set() // types and topics whose description was asked for
  #view = { ...START }
  #fitted = true
  #follow = false
  #seconds = memory.get("map-trail", 60)
  #canvas = h("canvas", { class: "map", role: "img", tabindex: "0", "aria-label": "Map" })
  #body = h("tbody")
  #none = h("p", { class: "empty" })
  #panZoom
  #isShown = false
  #now = undefined // s, the time of a recording; of a network the newest pose counts
  #nextStream = STREAMS
  #draw = oncePerFrame(() => this.#isShown && this.#paint())
  #look = () => this.#findTopics()

  constructor(app) {
    this.#app = app
    this.#panZoom = new PanZoom(this.#canvas, {
      move: (dx, dy) => this.#move(dx, dy), zoom: (factor, x, y) => this.#zoom(factor, x, y),
    })
    this.element = h("section", { class: "view full map-view" }, this.#bar(), this.#table(),
      h("div", { class: "fill map-body" }, this.#canvas))
    new ResizeObserver(this.#draw).observe(this.#canvas)
    document.addEventListener("theme", this.#draw)
    app.connection.addEventListener("hello", () => this.#begin())
    app.connection.addEventListener("clock", event => {
      this.#now = event.detail.time / 1e9
      this.#draw()
    })
  }

  show(argument) {
    this.#isShown = true
    this.#app.store.addEventListener("change", this.#look)
    this.#look()
    if (argument) this.#add(argument, { plot: true })
    this.#draw()
  }

  hide() {
    this.#isShown = false
    this.#app.store.removeEventListener("change", this.#look)
  }

  key(event) {
    if (event.key === "f") this.#fit()
    else if (event.key === "c") this.#clear()
    else return this.#panZoom.key(event)
    return true
  }

  #bar() {
    const trail = h("select", { onchange: () => {
      this.#seconds = TRAILS[trail.selectedIndex][0]
      memory.set("map-trail", this.#seconds)
      this.#draw()
    } }, TRAILS.map(([, text]) => h("option", {}, text)))
    trail.selectedIndex = Math.max(0, TRAILS.findIndex(([seconds]) => seconds === this.#seconds))
    const follow = button("Follow", () => {
      this.#follow = !this.#follow
      follow.setAttribute("aria-pressed", this.#follow)
      this.#fitted = false
      this.#draw()
    }, { "aria-pressed": "false", title: "Keep the first robot in the middle" })
    const zoom = (text, factor, name) => (
      button(text, () => this.#panZoom.zoomBy(factor), { "aria-label": name, title: name }))
    const other = button("Other topic", () => this.#ask(), { title: "Show a topic that was not found by its type" })
    return h("div", { class: "bar" }, h("h2", {}, "Map"), field("Trail", trail), other, h("span", { class: "space" }),
      button("Clear", () => this.#clear(), { title: "Clear the trails (c)" }), follow,
      zoom("−", 0.8, "Zoom out"), zoom("+", 1.25, "Zoom in"),
      button("Fit", () => this.#fit(), { title: "Fit all of it (f)" }))
  }

  #table() {
    const heads = [["Topic"], ["x", "m"], ["y", "m"], ["Heading", "°"], ["Points"]]
    return h("div", { class: "table-box map-table" }, h("table", { class: "plain" },
      h("caption", { class: "sr-only" }, "Poses on the map"),
      h("thead", {}, h("tr", {}, heads.map(([head, unit], index) => (
        h("th", { scope: "col", class: index ? "number" : null }, head, h("span", { class: "unit" }, ` ${unit ?? ""}`))
      )))), this.#body), this.#none)
  }

  // Topics

  // After another hello the process knows nothing of what this page has asked for.
  #begin() {
    this.#asked.clear()
    this.#now = undefined
    for (const topic of this.#topics.values()) {
      if (topic.stream) topic.stream = null
      topic.trail.clear()
      if (topic.box.checked) this.#plot(topic)
    }
    this.#look()
  }

  #findTopics() {
    for (const topic of this.#app.store.topics.values()) {
      const key = `${topic.name} ${topic.type ?? ""}`
      if (this.#asked.has(key) || topic.is_of_service || !mayHavePose(topic)) continue
      this.#asked.add(key)
      this.#add(topic.name, { plot: this.#topics.size < SHOWN_MAX, quiet: true }).then(isDescribed => {
        if (!isDescribed) setTimeout(() => this.#asked.delete(key), AGAIN)
      })
    }
    setText(this.#none, this.#topics.size ? "" : "No topic with a pose is known yet. Odometry, Pose and ROS's "
      + "nav_msgs/Odometry, PoseStamped and TransformStamped are found by their type.")
    this.#none.hidden = this.#topics.size > 0
  }

  #ask() {
    const names = [...this.#app.store.topics.keys()].sort().filter(name => !this.#topics.has(name))
    const choice = h("select", {}, names.map(name => h("option", {}, name)))
    const add = button("Show", () => {
      dialog.close()
      if (choice.value) this.#add(choice.value, { plot: true })
    }, { class: "primary" })
    const dialog = openDialog({ title: "Show another topic", body: field("Topic", choice), actions: [add] })
  }

  // Show a topic, if it has a pose; return whether its type is known.
  async #add(name, { plot, quiet = false }) {
    const known = this.#topics.get(name)
    if (known && plot) this.#check(known, true)
    if (known) return true
    const wanted = this.#app.connection.request("describe", { topic: name })
    const description = await (quiet ? wanted.catch(() => null) : attempt(wanted))
    if (!description || this.#topics.has(name)) return Boolean(description)
    const pose = poseOf(description)
    if (pose) this.#place({ name, reader: readerOf(pose), trail: new Trail(), stream: null }, plot)
    else if (!quiet) toast(`${name} has no pose: its type has no fields x and y of a position`, "bad")
    return true
  }

  #place(topic, plot) {
    topic.colour = this.#topics.size % 8 + 1
    topic.box = h("input", { type: "checkbox", onchange: () => this.#check(topic, topic.box.checked) })
    topic.cells = Array.from({ length: 4 }, () => h("td", { class: "number" }, UNKNOWN))
    const swatch = h("span", { class: `swatch owner-${topic.colour}` })
    topic.row = h("tr", { dataset: { topic: topic.name } },
      h("th", { scope: "row" }, h("label", { class: "check" }, topic.box, swatch, topic.name)), topic.cells)
    this.#topics.set(topic.name, topic)
    this.#body.append(topic.row)
    this.#none.hidden = true
    if (plot) this.#check(topic, true)
  }

  #check(topic, shown) {
    topic.box.checked = shown
    if (shown && !topic.stream) this.#plot(topic)
    if (!shown && topic.stream) {
      this.#app.connection.onPoints(topic.stream, null)
      this.#app.connection.request("stop_plot", { stream: topic.stream }).catch(() => {})
      topic.stream = null
      topic.trail.clear()
    }
    this.#draw()
  }

  #plot(topic) {
    topic.stream = this.#nextStream++
    this.#app.connection.onPoints(topic.stream, (times, columns) => this.#take(topic, times, columns))
    const fields = topic.reader.paths.map(path => `${topic.name}.${path}`)
    attempt(this.#app.connection.request("plot", { stream: topic.stream, fields }))
  }

  #take(topic, times, columns) {
    if (this.#app.hello?.recording) topic.trail.clear() // of a recording, points replace all before them
    for (let i = 0; i < times.length; i++) {
      topic.trail.add(times[i], topic.reader.read(columns.map(column => column[i])))
    }
    this.#draw()
  }

  // The view: pixels right and down, metres right and up

  #size() {
    return { width: Math.max(1, this.#canvas.clientWidth), height: Math.max(1, this.#canvas.clientHeight) }
  }

  #move(dx, dy) {
    this.#view.x -= dx / this.#view.scale
    this.#view.y += dy / this.#view.scale
    this.#fitted = false
    this.#draw()
  }

  #zoom(factor, x, y) {
    const { width, height } = this.#size()
    const scale = Math.min(SCALE_MAX, Math.max(SCALE_MIN, this.#view.scale * factor))
    const real = 1 / this.#view.scale - 1 / scale
    this.#view = {
      scale, x: this.#view.x + (x - width / 2) * real, y: this.#view.y - (y - height / 2) * real,
    }
    this.#fitted = false
    this.#draw()
  }

  #fit() {
    this.#fitted = true
    this.#draw()
  }

  #clear() {
    for (const { trail } of this.#topics.values()) trail.clear()
    this.#draw()
  }

  #adjust(trails) {
    if (this.#follow) {
      const last = trails.find(trail => trail.last)?.last
      if (last) Object.assign(this.#view, { x: last.x, y: last.y })
    } else if (this.#fitted) this.#fitTo(boundsOf(trails.flatMap(({ points }) => points)))
  }

  #fitTo(bounds) {
    if (!bounds) return
    const { width, height } = this.#size()
    const wide = Math.max(SIZE_MIN, 1.25 * (bounds.right - bounds.left))
    const high = Math.max(SIZE_MIN, 1.25 * (bounds.top - bounds.bottom))
    this.#view = {
      x: (bounds.left + bounds.right) / 2, y: (bounds.bottom + bounds.top) / 2,
      scale: Math.min(width / wide, height / high),
    }
  }

  #paint() {
    const now = this.#app.hello?.recording ? this.#now ?? this.#app.store.time / 1e9 : undefined
    const trails = [...this.#topics.values()].filter(topic => topic.box.checked)
      .map(topic => ({ topic, points: topic.trail.since(this.#seconds, now) }))
      .map(({ topic, points }) => ({ topic, points, last: points.at(-1) }))
    this.#adjust(trails)
    const { width, height } = this.#size()
    const ratio = window.devicePixelRatio || 1
    if (this.#canvas.width !== Math.round(width * ratio) || this.#canvas.height !== Math.round(height * ratio)) {
      this.#canvas.width = Math.round(width * ratio)
      this.#canvas.height = Math.round(height * ratio)
    }
    const pen = this.#canvas.getContext("2d")
    pen.setTransform(ratio, 0, 0, ratio, 0, 0)
    pen.clearRect(0, 0, width, height)
    const place = ({ x, y }) => [
      width / 2 + (x - this.#view.x) * this.#view.scale, height / 2 - (y - this.#view.y) * this.#view.scale,
    ]
    this.#paintGrid(pen, width, height, place)
    for (const { topic, points, last } of trails) {
      paintTrail(pen, points, last, color(`--series-${topic.colour}`), place)
    }
    this.#write(trails)
  }

  #paintGrid(pen, width, height, place) {
    const step = gridStep(this.#view.scale)
    const half = { x: width / 2 / this.#view.scale, y: height / 2 / this.#view.scale }
    pen.lineWidth = 1
    pen.font = `11px ${color("--mono")}`
    pen.fillStyle = color("--dim")
    const line = (from, to, zero) => {
      pen.strokeStyle = color(zero ? "--edge" : "--line")
      pen.beginPath()
      pen.moveTo(...from)
      pen.lineTo(...to)
      pen.stroke()
    }
    const write = (text, x, y) => {
      pen.lineWidth = 4
      pen.strokeStyle = color("--back")
      pen.strokeText(text, x, y)
      pen.fillText(text, x, y)
      pen.lineWidth = 1
    }
    for (const n of lines(this.#view.x - half.x, this.#view.x + half.x, step)) {
      const [x] = place({ x: n * step, y: 0 })
      line([Math.round(x) + 0.5, 0], [Math.round(x) + 0.5, height], n === 0)
      if (x < width - 60) write(lengthText(n * step, step), x + 4, height - 6)
    }
    for (const n of lines(this.#view.y - half.y, this.#view.y + half.y, step)) {
      const [, y] = place({ x: 0, y: n * step })
      line([0, Math.round(y) + 0.5], [width, Math.round(y) + 0.5], n === 0)
      if (y < height - 24) write(lengthText(n * step, step), 4, y - 4)
    }
    this.#paintScale(pen, width, step)
  }

  #paintScale(pen, width, step) {
    const length = step * this.#view.scale
    pen.strokeStyle = pen.fillStyle = color("--text")
    pen.beginPath()
    pen.moveTo(width - 14 - length, 14)
    pen.lineTo(width - 14 - length, 20)
    pen.lineTo(width - 14, 20)
    pen.lineTo(width - 14, 14)
    pen.stroke()
    const text = lengthText(step)
    pen.fillText(text, width - 14 - length / 2 - pen.measureText(text).width / 2, 14)
  }

  // The table says the same as the picture.
  #write(trails) {
    for (const { topic, points, last } of trails) {
      const degrees = last?.heading === null || !last ? UNKNOWN : fixed(last.heading * 180 / Math.PI)
      const texts = [fixed(last?.x, 3), fixed(last?.y, 3), degrees, String(points.length)]
      topic.cells.forEach((cell, index) => setText(cell, texts[index]))
    }
    const said = trails.filter(({ last }) => last).map(({ topic, last: { x, y } }) => (
      `${topic.name} at ${fixed(x, 2)} m, ${fixed(y, 2)} m`))
    this.#canvas.setAttribute("aria-label", `Map: ${said.join("; ") || "no poses yet"}. The table has the figures.`)
    Object.assign(this.#canvas.dataset, { points: trails.reduce((sum, { points }) => sum + points.length, 0) })
  }
}

function* lines(from, to, step) {
  for (let n = Math.ceil(from / step); n <= to / step; n++) yield n
}

function paintTrail(pen, points, last, stroke, place) {
  if (!last) return
  pen.strokeStyle = pen.fillStyle = stroke
  pen.lineWidth = 2
  pen.lineJoin = "round"
  pen.beginPath()
  points.forEach((point, index) => (index ? pen.lineTo(...place(point)) : pen.moveTo(...place(point))))
  pen.stroke()
  const [x, y] = place(last)
  pen.save()
  pen.translate(x, y)
  if (last.heading !== null) pen.rotate(-last.heading)
  pen.beginPath()
  if (last.heading === null) pen.arc(0, 0, ROBOT / 2, 0, 2 * Math.PI)
  else shape(pen)
  pen.fill()
  pen.restore()
}

// A robot that looks to the right.
function shape(pen) {
  pen.moveTo(ROBOT, 0)
  pen.lineTo(-ROBOT * 0.7, ROBOT * 0.7)
  pen.lineTo(-ROBOT * 0.35, 0)
  pen.lineTo(-ROBOT * 0.7, -ROBOT * 0.7)
  pen.closePath()
}
