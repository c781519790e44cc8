// What plots ask of the process: one stream for each topic, with all fields of it that any plot shows.

import { Series } from "./series.js"

const RETRY = 5_000 // ms

let numbers = 0

function topicOf(name) {
  return name.split(".", 1)[0]
}

// One topic. Its `series` has the points; `errors` says of fields why there are none.
class TopicStream {
  series = new Series()
  errors = new Map()
  users = new Map() // how many plots show a field
  #connection
  #recording
  #stream = null
  #range = {}
  #changed
  #renewing = null
  #again = false

  constructor(connection, recording, changed) {
    this.#connection = connection
    this.#recording = recording
    this.#changed = changed
  }

  use(field) {
    this.users.set(field, (this.users.get(field) ?? 0) + 1)
    if (this.users.get(field) > 1) return
    this.series.addField(field)
    this.renew()
  }

  release(field) {
    const users = this.users.get(field) - 1
    if (users) return this.users.set(field, users)
    this.users.delete(field)
    this.errors.delete(field)
    this.series.removeField(field)
    return this.renew()
  }

  // Ask a recording for another part of it, with as many points as pixels.
  look(range) {
    this.#range = range
    this.renew()
  }

  // Ask again for all fields: they have changed, or the connection is a new one. Soon, and once for several changes.
  renew({ connection = false } = {}) {
    if (connection) this.#stream = null
    if (this.#renewing) {
      this.#again = true
      return
    }
    this.#renewing = Promise.resolve().then(() => this.#ask()).finally(() => {
      this.#renewing = null
      if (this.#again) this.renew()
      this.#again = false
    })
  }

  // One field that can't be plotted doesn't take the others with it: then each of them is tried.
  async #ask() {
    const fields = [...this.users.keys()]
    this.errors.clear()
    if (!fields.length) return this.#stop()
    const error = await this.#request(fields)
    if (error && fields.length > 1) await this.#sift(fields)
    else if (error) this.errors.set(fields[0], error)
    return this.#changed()
  }

  async #sift(fields) {
    const good = []
    for (const field of fields) {
      const error = await this.#request([...good, field])
      if (error) this.errors.set(field, error)
      else good.push(field)
    }
  }

  // Each request has a number of its own, so that points on their way are not taken for those of other fields.
  async #request(fields) {
    const before = this.#stream
    const stream = numbers++ % 65_536
    let overlap = true
    this.#connection.onPoints(stream, (times, columns) => {
      this.#take(fields, times, columns, overlap)
      overlap = false
    })
    try {
      await this.#connection.request("plot", { stream, fields, ...this.#range })
    } catch (error) {
      this.#connection.onPoints(stream, null)
      return error.message
    }
    this.#stream = stream
    this.#end(before)
    return ""
  }

  #take(fields, times, columns, overlap) {
    if (this.#recording()) this.series.replace(fields, times, columns)
    else this.series.append(fields, times, columns, { overlap })
    this.#changed(times.length * columns.length)
  }

  #stop() {
    this.#end(this.#stream)
    this.#stream = null
  }

  #end(stream) {
    if (stream === null) return
    this.#connection.onPoints(stream, null)
    this.#connection.request("stop_plot", { stream }).catch(() => {}) // a connection that is lost has ended it
  }
}

// All topics that are plotted. The event "points" says that something is new; its detail is how many numbers came.
export class Streams extends EventTarget {
  #app
  #topics = new Map()
  #tried = new Map()

  constructor(app) {
    super()
    this.#app = app
    app.connection.addEventListener("hello", () => {
      for (const stream of this.#topics.values()) stream.renew({ connection: true })
    })
    app.store.addEventListener("change", () => this.#retry())
  }

  // Return the points of a field, for as long as they are used.
  use(name) {
    const topic = topicOf(name)
    if (!this.#topics.has(topic)) this.#topics.set(topic, this.#create())
    const stream = this.#topics.get(topic)
    stream.use(name)
    return stream
  }

  release(name) {
    const topic = topicOf(name)
    const stream = this.#topics.get(topic)
    stream.release(name)
    if (!stream.users.size) this.#topics.delete(topic)
  }

  look(range) {
    for (const stream of this.#topics.values()) stream.look(range)
  }

  all() {
    return [...this.#topics.values()].map(stream => stream.series)
  }

  #create() {
    return new TopicStream(this.#app.connection, () => this.#app.hello?.recording,
      (numbers = 0) => this.dispatchEvent(new CustomEvent("points", { detail: numbers })))
  }

  // What could not be plotted is tried again when the topic has got a type or a publisher; a topic of which nothing
  // could be plotted also after a while, as its module may only have been slow to answer.
  #retry() {
    for (const [topic, stream] of this.#topics) {
      const row = this.#app.store.topics.get(topic)
      const state = `${row?.type} ${row?.publishers?.length}`
      const before = this.#tried.get(topic) ?? { state, time: performance.now() }
      const isDue = stream.errors.size === stream.users.size && performance.now() - before.time > RETRY
      const isNews = before.state !== state
      if (stream.errors.size && (isDue || isNews)) stream.renew()
      this.#tried.set(topic, isDue || isNews ? { state, time: performance.now() } : before)
    }
  }
}
