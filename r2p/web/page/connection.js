// The connection to the process that serves this page: r2p/web/dash/protocol.py has the protocol.

const POINTS = 1
const RETRY = 1_000 // ms, and then twice as long each time
const RETRY_MAX = 8_000 // ms
const TOKEN = "r2p-token"

// The token of the link stays in this tab, and out of the address bar. It may go before the address of a view:
// #token=TOKEN/plots/odometry.pose.x
function token() {
  const [, given, view] = location.hash.match(/^#token=([^/&]+)(\/.*)?$/) ?? []
  try {
    if (given) sessionStorage.setItem(TOKEN, decodeURIComponent(given))
    if (given) history.replaceState(null, "", location.pathname + (view ? `#${view}` : ""))
    return sessionStorage.getItem(TOKEN)
  } catch {
    return given ?? null // the browser stores nothing for this page
  }
}

export class Connection extends EventTarget {
  #socket = null
  #pending = new Map()
  #streams = new Map()
  #next = 1
  #token = token()
  #wait = RETRY
  #timer = 0
  #ever = false

  // Connect now, unless it is connected. News are events by their `op`; "lost" has {reason, wait (ms), ever}.
  open() {
    clearTimeout(this.#timer)
    if (this.#socket && this.#socket.readyState <= WebSocket.OPEN) return
    const query = this.#token ? `?token=${encodeURIComponent(this.#token)}` : ""
    const scheme = location.protocol === "https:" ? "wss" : "ws"
    const socket = new WebSocket(`${scheme}://${location.host}/dash${query}`)
    socket.binaryType = "arraybuffer"
    socket.onmessage = event => this.#receive(event.data)
    socket.onclose = event => this.#lose(event.reason)
    this.#socket = socket
  }

  // Ask the process, and return the promise of its answer; it fails with the reason that the process gives.
  request(op, values = {}) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return Promise.reject(new Error("not connected"))
    const id = this.#next++
    this.#socket.send(JSON.stringify({ op, id, ...values }))
    return new Promise((resolve, reject) => this.#pending.set(id, { resolve, reject }))
  }

  // Call `handle(times, columns)` with the points of a stream; null: no longer.
  onPoints(stream, handle) {
    if (handle) this.#streams.set(stream, handle)
    else this.#streams.delete(stream)
  }

  #receive(data) {
    if (typeof data !== "string") return this.#receivePoints(data)
    const message = JSON.parse(data)
    if (message.op === "hello") this.#settle()
    if (message.op) return this.dispatchEvent(new CustomEvent(message.op, { detail: message }))
    const pending = this.#pending.get(message.id)
    this.#pending.delete(message.id)
    if (message.error !== undefined) pending?.reject(new Error(message.error))
    else pending?.resolve(message.result)
  }

  #receivePoints(data) {
    const view = new DataView(data)
    if (view.getUint8(0) !== POINTS) return
    const count = view.getUint32(4, true)
    const column = index => new Float64Array(data, 8 + 8 * count * index, count)
    const columns = Array.from({ length: view.getUint8(1) }, (_, index) => column(index + 1))
    this.#streams.get(view.getUint16(2, true))?.(column(0), columns)
  }

  #settle() {
    this.#wait = RETRY
    this.#ever = true
  }

  #lose(reason) {
    for (const { reject } of this.#pending.values()) reject(new Error("the connection was lost"))
    this.#pending.clear()
    this.#streams.clear()
    this.#timer = setTimeout(() => this.open(), this.#wait)
    this.dispatchEvent(new CustomEvent("lost", { detail: { reason, wait: this.#wait, ever: this.#ever } }))
    this.#wait = Math.min(2 * this.#wait, RETRY_MAX)
  }
}
