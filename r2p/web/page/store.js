// The figures of the network, as the last states have them.

const TABLES = ["modules", "topics", "services", "links", "buses"]

export class Store extends EventTarget {
  constructor(connection) {
    super()
    this.clear()
    connection.addEventListener("hello", () => this.clear())
    connection.addEventListener("state", event => this.#update(event.detail))
  }

  clear() {
    this.time = 0
    for (const table of TABLES) this[table] = new Map()
  }

  #update({ time, network, changed, gone }) {
    this.time = time
    this.network = network
    for (const table of TABLES) {
      for (const key of gone[table] ?? []) this[table].delete(key)
      for (const [key, row] of Object.entries(changed[table] ?? {})) this[table].set(key, row)
    }
    this.dispatchEvent(new Event("change"))
  }
}
