// The points of plots: kept in arrays of numbers, and thinned to the smallest and largest value of each pixel.

export const POINTS_MAX = 200_000 // kept of each field, at least; 200 s at 1 kHz
const POINTS_FIRST = 4_096
const SET_BACK = 2 // s

// The points of one topic: times (s, UTC), which only grow, and a column of values for each field. NaN: no value then.
export class Series {
  times = new Float64Array(POINTS_FIRST)
  columns = new Map()
  length = 0
  dropped = 0 // points that are gone: what follows the points counts on from there
  version = 0 // differs after all points have been replaced

  get last() {
    return this.length ? this.times[this.length - 1] : -Infinity
  }

  addField(field) {
    if (!this.columns.has(field)) this.columns.set(field, new Float64Array(this.times.length).fill(NaN))
  }

  removeField(field) {
    this.columns.delete(field)
  }

  // Append points, `columns` in the order of `fields`. Of an `overlap` those are left out that are here already.
  append(fields, times, columns, { overlap = false } = {}) {
    if (times.length && times[times.length - 1] < this.last - SET_BACK) this.#clear()
    const skip = overlap ? upper(times, times.length, this.last) : 0
    const size = Math.min(times.length - skip, POINTS_MAX)
    if (size <= 0) return
    const from = times.length - size
    this.#reserve(size)
    this.times.set(times.subarray(from), this.length)
    for (const [field, column] of this.columns) {
      const index = fields.indexOf(field)
      if (index < 0) column.fill(NaN, this.length, this.length + size)
      else column.set(columns[index].subarray(from), this.length)
    }
    this.#straighten(size)
    this.length += size
  }

  // Several publishers of a topic overtake each other: their points stay in the order of their arrival.
  #straighten(size) {
    for (let index = Math.max(1, this.length); index < this.length + size; index++)
      if (this.times[index] < this.times[index - 1]) this.times[index] = this.times[index - 1]
  }

  // The clock was set back: what was before has no place in time any more.
  #clear() {
    this.length = 0
    this.version++
  }

  replace(fields, times, columns) {
    this.times = times
    this.columns = new Map([...this.columns.keys()].map(field => {
      const index = fields.indexOf(field)
      return [field, index < 0 ? new Float64Array(times.length).fill(NaN) : columns[index]]
    }))
    this.length = times.length
    this.version++
  }

  // Return the index of the first point at a time or after it.
  indexAt(time) {
    return lower(this.times, this.length, time)
  }

  // Return the value of a field at a time: that of the last point until then. NaN if there is none.
  valueAt(field, time) {
    const index = upper(this.times, this.length, time) - 1
    return index < 0 ? NaN : this.columns.get(field)?.[index] ?? NaN
  }

  #reserve(size) {
    if (this.length + size <= this.times.length) return undefined
    if (this.length + size <= 2 * POINTS_MAX) return this.#grow(this.length + size)
    const gone = this.length - POINTS_MAX + size
    for (const array of [this.times, ...this.columns.values()]) array.copyWithin(0, gone, this.length)
    this.length -= gone
    this.dropped += gone
    return undefined
  }

  #grow(needed) {
    let size = this.times.length
    while (size < needed) size *= 2
    const grown = array => {
      const larger = new Float64Array(Math.min(size, 2 * POINTS_MAX))
      larger.set(array.subarray(0, this.length))
      return larger
    }
    this.times = grown(this.times)
    for (const [field, column] of this.columns) this.columns.set(field, grown(column))
  }
}

function lower(times, length, time) {
  let low = 0
  let high = length
  while (low < high) {
    const middle = (low + high) >> 1
    if (times[middle] < time) low = middle + 1
    else high = middle
  }
  return low
}

function upper(times, length, time) {
  let low = 0
  let high = length
  while (low < high) {
    const middle = (low + high) >> 1
    if (times[middle] <= time) low = middle + 1
    else high = middle
  }
  return low
}

const EMPTY = 0
const GAP = 1 // only points without a value
const RISING = 2 // its largest value is the later one
const FALLING = 3

// The smallest and the largest value of a field in each step of time. Steps are counted from the epoch and not from the
// edge of the plot: what has been drawn keeps its shape while it moves, and only new points cost anything.
export class Steps {
  #series
  #field
  #step
  #first = 0
  #next = 0 // index of the next point to be read, with those that are gone
  #version = -1
  #low
  #high
  #kind

  constructor(series, field, step, size) {
    this.#series = series
    this.#field = field
    this.#step = step
    this.#low = new Float64Array(3 * size)
    this.#high = new Float64Array(3 * size)
    this.#kind = new Uint8Array(3 * size)
  }

  // Write two values for each step from `from` to `to` into `values`, as uPlot takes them: null is a gap, undefined
  // no point at all.
  read(from, to, values) {
    this.#prepare(from, to)
    this.#consume(to)
    for (let step = from, at = 0; step <= to; step++, at += 2) this.#put(step - this.#first, values, at)
  }

  #put(index, values, at) {
    const kind = this.#kind[index]
    if (kind < RISING) {
      values[at] = kind === GAP ? null : undefined
      values[at + 1] = undefined
      return
    }
    const low = this.#low[index]
    const high = this.#high[index]
    values[at] = kind === RISING ? low : high
    values[at + 1] = low === high ? undefined : kind === RISING ? high : low
  }

  #prepare(from, to) {
    const size = this.#kind.length
    const replaced = this.#version !== this.#series.version
    if (replaced || from < this.#first || from >= this.#first + size) return this.#restart(from)
    if (to - this.#first < size) return undefined
    const gone = from - this.#first
    for (const array of [this.#low, this.#high, this.#kind]) array.copyWithin(0, gone)
    this.#kind.fill(EMPTY, size - gone)
    this.#first = from
    return undefined
  }

  #restart(from) {
    this.#version = this.#series.version
    this.#first = from
    this.#kind.fill(EMPTY)
    this.#next = this.#series.dropped + this.#series.indexAt(from * this.#step)
  }

  #consume(to) {
    const { times, length, dropped } = this.#series
    const column = this.#series.columns.get(this.#field)
    if (!column) return
    let index = Math.max(0, this.#next - dropped)
    for (; index < length; index++) {
      const step = Math.floor(times[index] / this.#step)
      if (step > to) break
      if (step >= this.#first) this.#add(step - this.#first, column[index])
    }
    this.#next = index + dropped
  }

  #add(at, value) {
    if (Number.isNaN(value)) {
      if (this.#kind[at] === EMPTY) this.#kind[at] = GAP
    } else if (this.#kind[at] < RISING) {
      this.#low[at] = this.#high[at] = value
      this.#kind[at] = RISING
    } else if (value > this.#high[at]) {
      this.#high[at] = value
      this.#kind[at] = RISING
    } else if (value < this.#low[at]) {
      this.#low[at] = value
      this.#kind[at] = FALLING
    }
  }
}

const CSV_CHUNK = 1_000 // lines

// Return the points of fields, [{name, series, field}], between two times, as parts of a CSV file: a line for each time.
export function csv(fields, start, end) {
  const cursors = [...new Set(fields.map(each => each.series))].map(series => ({ series, index: series.indexAt(start) }))
  const parts = [`time,${fields.map(each => quoted(each.name)).join(",")}\n`]
  let lines = []
  for (;;) {
    const time = Math.min(...cursors.map(({ series, index }) => index < series.length ? series.times[index] : Infinity))
    if (!(time <= end)) break
    const here = new Map(cursors.filter(at => at.series.times[at.index] === time && at.index < at.series.length)
      .map(at => [at.series, at.index++]))
    lines.push(`${time.toFixed(6)},${fields.map(each => cell(each, here)).join(",")}\n`)
    if (lines.length >= CSV_CHUNK) parts.push(lines.splice(0).join(""))
  }
  return [...parts, lines.join("")]
}

function cell({ series, field }, here) {
  const value = here.has(series) ? series.columns.get(field)?.[here.get(series)] : NaN
  return value === undefined || Number.isNaN(value) ? "" : value
}

function quoted(name) {
  return /[",\n]/.test(name) ? `"${name.replaceAll('"', '""')}"` : name
}
