// Where a message has a position and a heading, and how a map shows them; without the DOM.

const QUATERNION = ["x", "y", "z", "w"]
// The positions of messages, ROS's and ours, by the path of x; and where the heading is, an angle or a quaternion.
const FORMS = [
  { at: "pose.pose.position", turn: "pose.pose.orientation" }, // Odometry, PoseWithCovarianceStamped
  { at: "pose.position", turn: "pose.orientation" }, // PoseStamped
  { at: "transform.translation", turn: "transform.rotation" }, // TransformStamped
  { at: "position", turn: "orientation" }, // Pose
  { at: "pose", angle: ["w", "theta"] }, // our Odometry
  { at: "", angle: ["theta"] }, // Pose2D, turtlesim's Pose
  { at: "", angle: ["w"], type: /pose/i }, // our Pose3; Velocity3 has the same fields
  { at: "point", angle: [] }, // PointStamped
]
const NAMES = /odom|pose/i

// Return {x, y, angle} or {x, y, turn: [4 paths]} of a type's description, or null if it has no position.
export function poseOf({ type = "", fields }) {
  const paths = new Set(fields.filter(field => field.plottable && field.length === undefined && field.max === undefined)
    .map(field => field.path))
  for (const form of FORMS) {
    const under = (at, name) => at ? `${at}.${name}` : name
    const x = under(form.at, "x")
    const y = under(form.at, "y")
    if (!paths.has(x) || !paths.has(y) || (form.type && !form.type.test(type))) continue
    const turn = form.turn && QUATERNION.map(name => under(form.turn, name))
    if (turn?.every(path => paths.has(path))) return { x, y, turn }
    const angle = form.angle?.map(name => under(form.at, name)).find(path => paths.has(path))
    if (angle) return { x, y, angle }
    if (!form.angle?.length) return { x, y }
  }
  return null
}

// Return whether a topic may have a pose by what is known of it without its description.
export function mayHavePose(topic) {
  return NAMES.test(topic.name.split("/").at(-1)) || /odom|pose|TransformStamped/i.test(topic.type ?? "")
}

// Return the paths that a plot asks for, and a function from their values to {x, y, heading (rad) or null}.
export function readerOf(pose) {
  if (pose.turn) {
    return { paths: [pose.x, pose.y, ...pose.turn], read: ([x, y, ...turn]) => ({ x, y, heading: yawOf(turn) }) }
  }
  const paths = [pose.x, pose.y, ...(pose.angle ? [pose.angle] : [])]
  return { paths, read: ([x, y, angle]) => ({ x, y, heading: angle ?? null }) }
}

// Return the heading of a quaternion, counter-clockwise from the x axis; null for one that is all zero.
export function yawOf([x, y, z, w]) {
  if (!x && !y && !z && !w) return null
  return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
}

// The way of one topic: the newest points, in order of time.
export class Trail {
  static #MAX = 20_000

  constructor() {
    this.clear()
  }

  clear() {
    this.points = []
    this.last = null
  }

  add(time, { x, y, heading }) {
    if (!Number.isFinite(x) || !Number.isFinite(y)) return
    this.last = { time, x, y, heading: Number.isFinite(heading) ? heading : null }
    this.points.push(this.last)
    if (this.points.length > 2 * Trail.#MAX) this.#thin()
  }

  // Return the points of the last seconds before a time, 0: all; without a time the newest ones.
  since(seconds, now = this.last?.time ?? 0) {
    const end = this.#indexAfter(now)
    return this.points.slice(seconds ? this.#indexAfter(now - seconds, { before: true }) : 0, end)
  }

  // Return the index of the first point after a time; with `before`, of the first one that is not before it.
  #indexAfter(time, { before = false } = {}) {
    let low = 0
    let high = this.points.length
    while (low < high) {
      const middle = (low + high) >> 1
      if (this.points[middle].time < time || (!before && this.points[middle].time === time)) low = middle + 1
      else high = middle
    }
    return low
  }

  // Of a long way the older half loses every other point: the newest ones stay exact.
  #thin() {
    this.points = this.points.filter((_, index) => index >= Trail.#MAX || index % 2 === 0)
  }
}

// Return the least and greatest x and y of points: {left, right, bottom, top}, or null if there are none.
export function boundsOf(points) {
  if (!points.length) return null
  const bounds = { left: Infinity, right: -Infinity, bottom: Infinity, top: -Infinity }
  for (const { x, y } of points) {
    bounds.left = Math.min(bounds.left, x)
    bounds.right = Math.max(bounds.right, x)
    bounds.bottom = Math.min(bounds.bottom, y)
    bounds.top = Math.max(bounds.top, y)
  }
  return bounds
}

// Return the distance of grid lines (m) for a scale (px per m): 1, 2 or 5 times a power of ten, at least `least` px.
export function gridStep(scale, least = 60) {
  const wanted = least / scale
  const power = 10 ** Math.floor(Math.log10(wanted))
  return [1, 2, 5, 10].find(each => each * power >= wanted) * power
}

// Return a length as text, with the unit that fits the step.
export function lengthText(metres, step = metres) {
  const size = Math.abs(step)
  if (size >= 1000) return `${+(metres / 1000).toPrecision(10)} km`
  if (size >= 1) return `${+metres.toPrecision(10)} m`
  return size >= 0.01 ? `${+(metres * 100).toPrecision(10)} cm` : `${+(metres * 1000).toPrecision(10)} mm`
}
