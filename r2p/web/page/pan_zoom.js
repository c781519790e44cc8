// Moving and zooming with the mouse, with fingers, and with keys.

const WHEEL = 0.0015 // of the size, for each pixel of a wheel
const KEY_ZOOM = 1.25
const KEY_STEP = 40 // px
const CLICK = 4 // px that a pointer may move within a click

// Call `move(dx, dy)` and `zoom(factor, x, y)` with pixels of the element, as the user moves and zooms it.
export class PanZoom {
  #element
  #move
  #zoom
  #pointers = new Map()
  #way = 0

  constructor(element, { move, zoom }) {
    this.#element = element
    this.#move = move
    this.#zoom = zoom
    element.addEventListener("pointerdown", event => this.#down(event))
    element.addEventListener("pointermove", event => this.#drag(event))
    for (const end of ["pointerup", "pointercancel"]) element.addEventListener(end, event => this.#up(event))
    element.addEventListener("wheel", event => this.#wheel(event), { passive: false })
    element.addEventListener("click", event => this.#click(event), { capture: true })
  }

  // Act on a key; return whether it was one.
  key(event) {
    const { width, height } = this.#element.getBoundingClientRect()
    const zooms = { "+": KEY_ZOOM, "=": KEY_ZOOM, "-": 1 / KEY_ZOOM }
    const moves = {
      ArrowLeft: [KEY_STEP, 0], ArrowRight: [-KEY_STEP, 0], ArrowUp: [0, KEY_STEP], ArrowDown: [0, -KEY_STEP],
    }
    if (event.key in zooms) this.#zoom(zooms[event.key], width / 2, height / 2)
    else if (event.key in moves) this.#move(...moves[event.key])
    else return false
    return true
  }

  zoomBy(factor) {
    const { width, height } = this.#element.getBoundingClientRect()
    this.#zoom(factor, width / 2, height / 2)
  }

  #place(event) {
    const box = this.#element.getBoundingClientRect()
    return { x: event.clientX - box.left, y: event.clientY - box.top }
  }

  #down(event) {
    if (event.button) return
    if (!this.#pointers.size) this.#way = 0
    this.#pointers.set(event.pointerId, this.#place(event))
  }

  #drag(event) {
    const before = this.#pointers.get(event.pointerId)
    if (!before) return
    const now = this.#place(event)
    this.#way += Math.hypot(now.x - before.x, now.y - before.y)
    if (this.#way > CLICK && !this.#element.hasPointerCapture(event.pointerId)) {
      this.#element.setPointerCapture(event.pointerId)
    }
    if (this.#pointers.size === 2) this.#pinch(event.pointerId, before, now)
    else if (this.#way > CLICK) this.#move(now.x - before.x, now.y - before.y)
    this.#pointers.set(event.pointerId, now)
  }

  #pinch(id, before, now) {
    const [, other] = [...this.#pointers].find(([each]) => each !== id)
    const distance = point => Math.max(1, Math.hypot(point.x - other.x, point.y - other.y))
    this.#zoom(distance(now) / distance(before), (now.x + other.x) / 2, (now.y + other.y) / 2)
    this.#move((now.x - before.x) / 2, (now.y - before.y) / 2)
  }

  #up(event) {
    this.#pointers.delete(event.pointerId)
  }

  #wheel(event) {
    event.preventDefault()
    const { x, y } = this.#place(event)
    this.#zoom(Math.exp(-event.deltaY * WHEEL * (event.deltaMode ? 16 : 1)), x, y)
  }

  // The end of a drag is not a click on what is below.
  #click(event) {
    if (this.#way <= CLICK) return
    event.stopPropagation()
    this.#way = 0
  }
}
