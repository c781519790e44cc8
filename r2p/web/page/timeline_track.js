// The track of the time line: a canvas with events, misses and gaps, and a slider over it for mouse, touch and keys.

import { button, color, h, oncePerFrame } from "./dom.js"
import { clock } from "./format.js"
import { BAD_KINDS, elapsed } from "./timeline_events.js"

const HEIGHT = 44
const ZOOM = 1.5
const SHORTEST = 0.02 // s that the track shows at least
const STEPS = [1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600,
  7200, 21_600, 86_400, 604_800, 31_536_000]
const TICK_WIDTH = 90 // px between two labels, about

export class Track {
  dragging = false
  #timeline
  #from = 0
  #to = 1
  #pointers = new Map()
  #pinch = null
  #redraw = oncePerFrame(() => this.#paint())

  constructor(timeline) {
    this.#timeline = timeline
    this.canvas = h("canvas", { "aria-hidden": "true" })
    this.tip = h("p", { class: "timeline-tip", hidden: true, "aria-hidden": "true" })
    this.slider = h("div", {
      class: "timeline-slider", role: "slider", tabindex: 0, "aria-label": "Time in the recording",
      "aria-valuemin": 0, "aria-valuemax": 0, "aria-valuenow": 0,
      onkeydown: event => this.#press(event), onpointerdown: event => this.#down(event),
      onpointermove: event => this.#move(event), onpointerup: event => this.#up(event),
      onpointercancel: event => this.#up(event), onpointerleave: () => { this.tip.hidden = true },
      ondblclick: () => this.reset(),
    })
    this.slider.addEventListener("wheel", event => this.#wheel(event), { passive: false })
    this.element = h("div", { class: "timeline-track" }, this.canvas, this.slider, this.tip)
    const small = (text, label, act) => button(text, act, { class: "quiet", "aria-label": label, title: label })
    this.buttons = [
      small("−", "Zoom out (- on the time line)", () => this.#zoom(ZOOM)),
      small("+", "Zoom in (+ on the time line)", () => this.#zoom(1 / ZOOM)),
      small("All", "Show all of the time (0 on the time line)", () => this.reset()),
    ]
    new ResizeObserver(() => this.draw()).observe(this.element)
    new MutationObserver(() => this.draw()).observe(document.documentElement, { attributeFilter: ["data-theme"] })
  }

  draw() {
    this.#redraw()
  }

  // Show all of the time.
  reset() {
    this.#from = this.#timeline.start
    this.#to = Math.max(this.#timeline.end, this.#from + SHORTEST)
    this.draw()
  }

  // Turn the page when a recording that plays leaves the part that is shown.
  keepInView(time) {
    if (time >= this.#from && time <= this.#to) return
    const width = this.#to - this.#from
    this.#set(time - width * 0.1, width)
  }

  #set(from, width) {
    const { start, end } = this.#timeline
    const all = Math.max(end - start, SHORTEST)
    const kept = Math.min(Math.max(width, SHORTEST), all)
    this.#from = Math.min(Math.max(from, start), start + all - kept)
    this.#to = this.#from + kept
    this.draw()
  }

  #zoom(factor, at = this.#center()) {
    const width = (this.#to - this.#from) * factor
    this.#set(at - (at - this.#from) * factor, width)
  }

  #center() {
    const { time } = this.#timeline
    return time >= this.#from && time <= this.#to ? time : (this.#from + this.#to) / 2
  }

  #timeAt(x) {
    const { left, width } = this.slider.getBoundingClientRect()
    return this.#from + (x - left) / Math.max(width, 1) * (this.#to - this.#from)
  }

  // Mouse, touch and keys

  #down(event) {
    if (event.button !== 0) return
    this.slider.setPointerCapture(event.pointerId)
    this.#pointers.set(event.pointerId, event.clientX)
    this.dragging = this.#pointers.size === 1
    if (this.dragging) this.#timeline.seek(this.#timeAt(event.clientX))
    else this.#pinch = this.#spread()
  }

  #move(event) {
    this.#hover(event)
    if (!this.#pointers.has(event.pointerId)) return
    this.#pointers.set(event.pointerId, event.clientX)
    if (this.#pointers.size === 1 && this.dragging) this.#timeline.seek(this.#timeAt(event.clientX))
    if (this.#pointers.size !== 2) return
    const spread = this.#spread()
    if (this.#pinch.distance > 8 && spread.distance > 8)
      this.#zoom(this.#pinch.distance / spread.distance, this.#timeAt(spread.middle))
    this.#pinch = spread
  }

  #up(event) {
    this.#pointers.delete(event.pointerId)
    if (!this.#pointers.size) this.dragging = false
  }

  #spread() {
    const [one, other] = [...this.#pointers.values()]
    return { distance: Math.abs(one - other), middle: (one + other) / 2 }
  }

  #wheel(event) {
    event.preventDefault()
    const width = this.#to - this.#from
    const sideways = event.shiftKey ? event.deltaY : event.deltaX
    if (Math.abs(sideways) > Math.abs(event.shiftKey ? 0 : event.deltaY)) this.#set(this.#from + width * sideways / 1000, width)
    else this.#zoom(event.deltaY > 0 ? 1.2 : 1 / 1.2, this.#timeAt(event.clientX))
  }

  #press(event) {
    const timeline = this.#timeline
    const width = this.#to - this.#from
    const small = Math.min(1, width / 50)
    const acts = {
      ArrowRight: () => timeline.seek(timeline.time + (event.shiftKey ? 10 * small : small)),
      ArrowLeft: () => timeline.seek(timeline.time - (event.shiftKey ? 10 * small : small)),
      ArrowUp: () => timeline.seek(timeline.time + small),
      ArrowDown: () => timeline.seek(timeline.time - small),
      PageUp: () => timeline.seek(timeline.time + width / 5),
      PageDown: () => timeline.seek(timeline.time - width / 5),
      Home: () => timeline.seek(timeline.start),
      End: () => timeline.seek(timeline.end),
      "+": () => this.#zoom(1 / ZOOM),
      "-": () => this.#zoom(ZOOM),
      0: () => this.reset(),
      n: () => timeline.events.step(1),
      b: () => timeline.events.step(-1),
      " ": () => timeline.toggle(),
    }
    if (!(event.key in acts) || event.ctrlKey || event.metaKey || event.altKey) return
    acts[event.key]()
    this.keepInView(timeline.time)
    event.preventDefault()
    event.stopPropagation()
  }

  #hover(event) {
    const time = this.#timeAt(event.clientX)
    const { left, width } = this.slider.getBoundingClientRect()
    const near = (this.#to - this.#from) / Math.max(width, 1) * 4
    const found = this.#timeline.marks.events.filter(each => Math.abs(each.time - time) <= near).slice(0, 3)
    const texts = found.map(each => `${each.kind} · ${each.about}: ${each.text}`)
    this.tip.textContent = [`${elapsed(Math.max(time - this.#timeline.start, 0), 2)}  (${clock(time, 2)})`, ...texts].join("\n")
    this.tip.hidden = false
    const x = Math.min(Math.max(event.clientX - left, 0), width - this.tip.offsetWidth)
    this.tip.style.transform = `translateX(${Math.round(Math.max(x, 0))}px)`
  }

  // Drawing

  #paint() {
    this.#announce()
    const width = this.element.clientWidth
    if (!width) return
    const ratio = window.devicePixelRatio || 1
    this.canvas.width = Math.round(width * ratio)
    this.canvas.height = Math.round(HEIGHT * ratio)
    const context = this.canvas.getContext("2d")
    context.scale(ratio, ratio)
    const x = time => (time - this.#from) / (this.#to - this.#from) * width
    this.#paintScale(context, width, x)
    this.#paintGaps(context, width, x)
    this.#paintMisses(context, width, x)
    this.#paintEvents(context, width, x)
    this.#paintCursor(context, x(this.#timeline.time))
  }

  #paintScale(context, width, x) {
    const wanted = (this.#to - this.#from) / Math.max(width / TICK_WIDTH, 1)
    const step = STEPS.find(each => each >= wanted) ?? STEPS.at(-1)
    const decimals = step >= 1 ? 0 : Math.ceil(-Math.log10(step) - 1e-9)
    const { start } = this.#timeline
    context.fillStyle = color("--dim")
    context.strokeStyle = color("--line")
    context.font = "11px system-ui, sans-serif"
    context.textBaseline = "alphabetic"
    context.beginPath()
    for (let i = Math.ceil((this.#from - start) / step); start + i * step <= this.#to; i++) {
      const at = x(start + i * step)
      context.moveTo(Math.round(at) + 0.5, 0)
      context.lineTo(Math.round(at) + 0.5, HEIGHT - 12)
      const text = elapsed(i * step, decimals)
      if (at + context.measureText(text).width < width) context.fillText(text, at + 3, HEIGHT - 2)
    }
    context.stroke()
  }

  // Where a topic of a steady rate has no messages: a band at the bottom.
  #paintGaps(context, width, x) {
    context.fillStyle = color("--edge")
    for (const each of this.#timeline.marks.gaps) {
      const left = Math.max(x(each.start), 0)
      const right = Math.min(x(each.end), width)
      if (right > left) context.fillRect(left, HEIGHT - 15, Math.max(right - left, 1), 2)
    }
  }

  // How many messages were missed, late or lost: bars that grow by powers of ten.
  #paintMisses(context, width, x) {
    const { marks, start } = this.#timeline
    const bars = new Map()
    for (const each of marks.misses) {
      const at = Math.round(x(start + (each.step + 0.5) * marks.step))
      if (at >= 0 && at <= width) bars.set(at, (bars.get(at) ?? 0) + each.count)
    }
    context.fillStyle = color("--bad")
    const thick = Math.max(2, Math.min(marks.step / (this.#to - this.#from) * width, 6))
    for (const [at, count] of bars) {
      const height = Math.min(3 + 4 * Math.log10(count + 1), 16)
      context.fillRect(at - thick / 2, HEIGHT - 16 - height, thick, height)
    }
  }

  // Events: ticks at the top, the bad ones longer and with a head.
  #paintEvents(context, width, x) {
    const [bad, other] = [color("--bad"), color("--accent")]
    for (const each of this.#timeline.marks.events) {
      const at = x(each.time)
      if (at < -2 || at > width + 2) continue
      const isBad = BAD_KINDS.has(each.kind)
      context.fillStyle = isBad ? bad : other
      context.fillRect(at - 0.75, 1, 1.5, isBad ? 11 : 7)
      if (isBad) context.fillRect(at - 2, 1, 4, 4)
    }
  }

  #paintCursor(context, at) {
    context.fillStyle = color("--text")
    context.fillRect(at - 1, 0, 2, HEIGHT - 12)
    context.beginPath()
    context.moveTo(at - 6, 0)
    context.lineTo(at + 6, 0)
    context.lineTo(at, 8)
    context.fill()
  }

  #announce() {
    const { start, end, time } = this.#timeline
    this.slider.setAttribute("aria-valuemax", (end - start).toFixed(3))
    this.slider.setAttribute("aria-valuenow", (time - start).toFixed(3))
    this.slider.setAttribute("aria-valuetext", `${elapsed(time - start)} of ${elapsed(end - start)}`)
  }
}
