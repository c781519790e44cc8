// Run by test_modules.py: `node --test`. The modules come from the package.

import assert from "node:assert/strict"
import { test } from "node:test"

const page = process.env.R2P_PAGE
const load = name => import(`${page}/${name}.js`)

const { place } = await load("dom")
const { arrange, edgeKey } = await load("graph_layout")
const { graphOf, Growth, isInfrastructure, shapeOf } = await load("graph_model")
const { controlOf, parseList, parseNumber, parseText, tree, zero } = await load("message_fields")
const { blamed, notesOf, parseValue } = await load("parameter_values")
const { boundsOf, gridStep, lengthText, poseOf, readerOf, Trail, yawOf } = await load("poses")

const AREA = { width: 1000, height: 700 }
const LETTERS = [..."abcdefgh"]
const boxes = LETTERS.map(id => ({ id, width: 100, height: 30 }))
const edges = [["a", "b"], ["b", "c"], ["c", "d"], ["a", "d"], ["d", "a"], ["e", "f"], ["f", "c"]]
  .map(([from, to]) => ({ from, to }))

test("a graph has the same places in whatever order its parts are given", () => {
  const one = arrange(boxes, edges, AREA)
  const other = arrange([...boxes].reverse(), [...edges].reverse(), AREA)
  for (const id of LETTERS) assert.deepEqual(one.places.get(id), other.places.get(id))
  for (const edge of edges) assert.deepEqual(one.routes.get(edgeKey(edge)), other.routes.get(edgeKey(edge)))
})

test("boxes never overlap, all are within the size, and circles have all of their edges", () => {
  for (const area of [AREA, { width: 300, height: 900 }]) {
    const { places, routes, width, height } = arrange(boxes, edges, area)
    assert.equal(routes.size, edges.length)
    const list = [...places.values()]
    for (const [index, one] of list.entries()) {
      assert.ok(one.x - one.width / 2 >= 0 && one.x + one.width / 2 <= width + 1e-9)
      assert.ok(one.y - one.height / 2 >= -1e-9 && one.y + one.height / 2 <= height + 1e-9)
      for (const other of list.slice(index + 1)) {
        const apart = Math.abs(one.x - other.x) >= 100 || Math.abs(one.y - other.y) >= 30 - 1e-9
        assert.ok(apart, "overlap")
      }
    }
  }
})

test("an empty graph, a loop and an edge that leads nowhere are fine", () => {
  assert.equal(arrange([], [], AREA).places.size, 0)
  assert.equal(arrange(boxes.slice(0, 1), [{ from: "a", to: "a" }, { from: "a", to: "x" }], AREA).routes.size, 0)
})

const publisher = (module, node, figures = {}) => ({ module, node, ...figures })
const store = (topics, modules) => ({
  topics: new Map(topics.map(topic => [topic.name, topic])),
  modules: new Map(modules.map(module => [module.name, module])),
})
const network = () => store([
  {
    name: "odometry", rate: 50, publishers: [publisher("M", "odo", { missed: 2 })],
    subscribers: [publisher("PC", "nav")],
  },
  { name: "robot1/log", publishers: [publisher("M", "log")], subscribers: [] },
  { name: "mine", publishers: [], subscribers: [publisher("TOOL", "dash")] },
], [
  { name: "M", link: "l", state: "running", nodes: [{ name: "odo" }, { name: "log" }] },
  { name: "PC", link: "l", state: "running" },
  { name: "FW", link: "l", state: "running" },
  { name: "TOOL", state: "observer" },
])

test("the graph leaves out logs, this tool, and what only these use", () => {
  const graph = graphOf(network())
  assert.deepEqual([...graph.elements.keys()].sort(), ["node FW", "node M/odo", "node PC/nav", "topic odometry"])
  assert.equal([...graph.edges.values()].find(edge => edge.role === "publish").rate, 50)
  assert.equal(graphOf(network(), { all: true }).elements.has("topic robot1/log"), true)
  assert.ok(isInfrastructure({ name: "a/b/log" }))
})

test("the graph by module has one box for each, and a filter keeps neighbours", () => {
  assert.ok(graphOf(network(), { byModule: true }).elements.has("node M"))
  const filtered = graphOf(network(), { words: ["nav"] })
  assert.deepEqual([...filtered.elements.keys()].sort(), ["node PC/nav", "topic odometry"])
  assert.ok(graphOf(network(), { limit: 1 }).left > 0)
})

test("figures do not change the shape of the graph", () => {
  const before = shapeOf(graphOf(network()))
  const later = network()
  later.topics.get("odometry").publishers[0].missed = 99
  assert.equal(shapeOf(graphOf(later)), before)
})

test("only what grew in the last seconds is a trouble", () => {
  const growth = new Growth()
  assert.equal(growth.note("k", 5, 0), 0) // counted before this page looked
  assert.equal(growth.note("k", 7, 1), 2)
  assert.equal(growth.note("k", 8, 2), 3)
  assert.equal(growth.note("k", 8, 4), 3)
  for (let time = 5; time < 20; time++) growth.note("k", 8, time)
  assert.equal(growth.note("k", 8, 20), 0)
  assert.equal(growth.note("k", 2, 21), 0) // it has started anew
  assert.equal(growth.note("k", 50, 99), 0) // nobody looked
  assert.equal(growth.note("k", undefined, 100), 0)
})

const fields = [
  { path: "name", kind: "text", limit: 4 }, { path: "points", kind: "message", max: 3 },
  { path: "points[].pose", kind: "message" }, { path: "points[].pose.x", kind: "f32" },
  { path: "gains", kind: "f64", length: 2 }, { path: "data", kind: "u8", max: 9 },
  { path: "on", kind: "bool" }, { path: "grid", kind: "array", length: 2 }, { path: "grid[]", kind: "u8", length: 2 },
]

test("fields become a tree, with the right control for each", () => {
  const root = tree(fields)
  assert.deepEqual(root.parts.map(part => [part.name, controlOf(part)]), [
    ["name", "text"], ["points", "messages"], ["gains", "numbers"], ["data", "list"], ["on", "bool"], ["grid", "json"],
  ])
  assert.equal(root.parts[1].parts[0].parts[0].path, "points[].pose.x")
  assert.deepEqual(zero(root).gains, [0, 0])
  assert.deepEqual(zero(root.parts[1]), [])
})

test("numbers are checked against their type, and lose no digits", () => {
  assert.equal(parseNumber("u8", " 0x1F "), 31)
  assert.equal(parseNumber("u64", "18446744073709551615"), "18446744073709551615")
  assert.equal(parseNumber("i64", "-9007199254740993"), "-9007199254740993")
  assert.equal(parseNumber("f32", "−1.5e-3"), -0.0015)
  assert.equal(parseNumber("f64", "NaN"), "nan")
  for (const [kind, text] of [
    ["u8", "256"], ["u8", "-1"], ["i8", "-129"], ["u16", "1.5"], ["u8", ""], ["f32", "1e39"], ["f64", "1e999"],
    ["f64", "x"], ["f64", "1,5"], ["u64", "18446744073709551616"],
  ]) assert.throws(() => parseNumber(kind, text), Error, `${kind} ${text}`)
})

test("texts and lists are checked against their sizes", () => {
  const [name, , gains, data] = tree(fields).parts
  assert.equal(parseText(name, "äö"), "äö")
  assert.throws(() => parseText(name, "äöü"), /6 bytes/)
  assert.deepEqual(parseList(gains, "[1, 2.5]"), [1, 2.5])
  assert.throws(() => parseList(gains, "1"), /1 elements/)
  assert.throws(() => parseList(data, "1 2 300"), /element 2/)
  assert.deepEqual(parseList(data, ""), [])
})

test("parameters say what they take, and which one an error means", () => {
  const gain = { kind: "float", minimum: 0, maximum: 1, unit: "A" }
  assert.equal(parseValue(gain, "0.5"), 0.5)
  assert.throws(() => parseValue(gain, "2"), /1 A or less/)
  assert.deepEqual(parseValue({ kind: "ints" }, "1, 2"), [1, 2])
  assert.equal(parseValue({ kind: "str" }, " a "), " a ")
  assert.equal(blamed("M/motor.kp2 = 3: it takes 1 or less", "M", "motor", ["kp", "kp2"]), "kp2")
  assert.equal(blamed("M does not answer", "M", "motor", ["kp"]), null)
  const notes = notesOf({ value: 1, origin: "run time" }).map(note => note.text)
  assert.deepEqual(notes, ["not saved", "from run time"])
})

const described = (type, ...paths) => ({ type, fields: paths.map(path => ({ path, kind: "f64", plottable: true })) })
const turn = at => ["x", "y", "z", "w"].map(name => `${at}.${name}`)

test("poses are found in our messages and ROS's, and velocities are not poses", () => {
  assert.equal(poseOf(described("r2p_msgs/Odometry", "pose.x", "pose.y", "pose.w", "velocity.x")).angle, "pose.w")
  assert.equal(poseOf(described("r2p_msgs/Pose3", "x", "y", "w")).angle, "w")
  assert.equal(poseOf(described("r2p_msgs/Velocity3", "x", "y", "w")), null)
  assert.equal(poseOf(described("turtlesim/Pose", "x", "y", "theta")).angle, "theta")
  const odometry = described("nav_msgs/Odometry", "pose.pose.position.x", "pose.pose.position.y",
    ...turn("pose.pose.orientation"))
  const { paths, read } = readerOf(poseOf(odometry))
  assert.equal(paths.length, 6)
  assert.ok(Math.abs(read([1, 2, 0, 0, Math.SQRT1_2, Math.SQRT1_2]).heading - Math.PI / 2) < 1e-9)
  assert.equal(yawOf([0, 0, 0, 0]), null)
})

test("a trail is bounded, and keeps its newest points", () => {
  const trail = new Trail()
  for (let i = 0; i < 100_000; i++) trail.add(i / 100, { x: i, y: -i, heading: NaN })
  trail.add(1e6, { x: NaN, y: 0, heading: 0 })
  assert.ok(trail.points.length <= 40_001)
  assert.deepEqual(trail.last, { time: 999.99, x: 99_999, y: -99_999, heading: null })
  assert.equal(trail.since(1).length, 101)
  assert.deepEqual(trail.since(0.02, 995).map(point => point.time), [994.98, 994.99, 995]) // of a recording
  assert.equal(trail.since(0, -1).length, 0)
  assert.deepEqual(boundsOf([{ x: 1, y: 2 }, { x: -1, y: 5 }]), { left: -1, right: 1, bottom: 2, top: 5 })
  assert.equal(boundsOf([]), null)
})

test("the grid has round steps", () => {
  assert.equal(gridStep(60), 1)
  assert.equal(gridStep(59), 2)
  assert.equal(gridStep(1000), 0.1)
  assert.equal(lengthText(0.3, 0.1), "30 cm")
  assert.equal(lengthText(1500, 500), "1500 m")
  assert.equal(lengthText(3000, 1000), "3 km")
})

// As much of an element as `place` needs. Whatever is taken out loses the keyboard, also when it is put back at once.
class Box {
  children = []
  parent = null
  losses = 0

  get firstElementChild() {
    return this.children[0] ?? null
  }

  get nextElementSibling() {
    return this.parent.children[this.parent.children.indexOf(this) + 1] ?? null
  }

  insertBefore(child, next) {
    child.remove()
    this.children.splice(next ? this.children.indexOf(next) : this.children.length, 0, child)
    child.parent = this
  }

  remove() {
    if (!this.parent) return
    this.parent.children.splice(this.parent.children.indexOf(this), 1)
    this.parent = null
    this.losses++
  }
}

test("children that stay keep the keyboard, wherever others come and go", () => {
  const boxes = Array.from({ length: 5 }, () => new Box())
  const subset = mask => boxes.filter((_, index) => mask >> index & 1)
  for (let before = 0; before < 32; before++) {
    for (let after = 0; after < 32; after++) {
      const parent = new Box()
      for (const box of boxes) Object.assign(box, { parent: null, losses: 0 })
      place(parent, subset(before))
      place(parent, subset(after))
      assert.deepEqual(parent.children, subset(after))
      for (const box of subset(before & after)) assert.equal(box.losses, 0)
    }
  }
})

test("children whose order changes are in the new one", () => {
  const boxes = Array.from({ length: 4 }, () => new Box())
  const parent = new Box()
  for (const order of [[0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0], [0, 1, 2, 3], [2], [], [2, 0]]) {
    place(parent, order.map(index => boxes[index]))
    assert.deepEqual(parent.children, order.map(index => boxes[index]))
  }
})
