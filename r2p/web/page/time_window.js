// The time that all plots show together: the newest seconds of a running network, or a part of what was before.

export const WIDTHS = [5, 10, 30, 60, 180] // s
const WIDTH_MIN = 0.001 // s
const WIDTH_MAX = 1e7 // s
const LAG_GROWS = 0.02 // of a second for each second: a clock that drifts, or a network that has become slower

export class TimeWindow extends EventTarget {
  live = true
  width = 10 // s
  end = 0 // s, UTC; of a window that is not live
  #lag = null // s from the newest point to this computer's clock

  // Return the window now; null as long as nothing is known.
  range() {
    const end = this.live ? this.#edge() : this.end
    return end === null ? null : { start: end - this.width, end }
  }

  // Points have come, the newest of this time. The edge moves with the clock between them, and not in jumps.
  heard(newest) {
    const lag = performance.now() / 1000 - newest
    this.#lag = this.#lag === null ? lag : Math.min(lag, this.#lag + LAG_GROWS * 0.04)
    if (lag - this.#lag > 2) this.#lag = lag // the publisher's clock was set
  }

  show(start, end) {
    this.width = Math.min(WIDTH_MAX, Math.max(WIDTH_MIN, end - start))
    this.end = this.width === end - start ? end : (start + end) / 2 + this.width / 2
    this.live = false
    this.#change()
  }

  // Zoom by a factor around a place in the window, 0 to 1 from its start. What is live stays so at its edge.
  zoom(factor, place = 1) {
    const range = this.range()
    if (!range) return
    const at = range.start + place * this.width
    const width = Math.min(WIDTH_MAX, Math.max(WIDTH_MIN, this.width * factor))
    if (this.live) {
      this.width = width
      this.#change()
    } else {
      this.show(at - place * width, at + (1 - place) * width)
    }
  }

  pan(seconds) {
    const range = this.range()
    if (range) this.show(range.start + seconds, range.end + seconds)
  }

  pause() {
    const range = this.range()
    if (range) this.show(range.start, range.end)
  }

  follow() {
    this.live = true
    if (!WIDTHS.includes(this.width)) this.width = 10
    this.#change()
  }

  setWidth(width) {
    const range = this.range()
    this.width = width
    if (range && !this.live) this.end = range.end
    this.#change()
  }

  #edge() {
    return this.#lag === null ? null : performance.now() / 1000 - this.#lag
  }

  #change() {
    this.dispatchEvent(new Event("change"))
  }
}
