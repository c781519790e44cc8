// What the graph shows, without the DOM: nodes and topics with their figures, and the edges between them.

const INFRASTRUCTURE = new Set(["log", "gateway", "bus_load", "bus_slots", "clock", "parameter_events", "rosout"])
const RECENT = 10 // s for which a counter that has grown is a trouble
const GAP = 5 // s without figures, after which what has grown since is not recent

// Says which counters have grown in the last seconds. `note` is called with each new state.
export class Growth {
  #last = new Map()

  // Return by how much a counter grew, while that is recent; else 0.
  note(key, value, time) {
    const last = this.#last.get(key)
    if (value === null || value === undefined) return 0
    if (!last || value < last.value || time - last.seen > GAP || time < last.seen) {
      this.#last.set(key, { value, seen: time, grown: 0, at: 0 })
      return 0
    }
    const added = value - last.value
    const fresh = last.grown > 0 && time - last.at <= RECENT
    if (added) Object.assign(last, { grown: (fresh ? last.grown : 0) + added, at: time })
    Object.assign(last, { value, seen: time })
    return last.grown && time - last.at <= RECENT ? last.grown : 0
  }
}

export const topicId = name => `topic ${name}`
export const nodeId = name => `node ${name}`

// Return {elements: Map of id to element, edges: Map of key to edge, left: how many elements are not shown}.
// `all`: also topics of services, logs and reports, and this tool's own module. `byModule`: a module is one box.
export function graphOf(store, { all = false, byModule = false, words = [], limit = Infinity } = {}) {
  const own = new Set([...store.modules.values()].filter(module => !module.link && !all).map(module => module.name))
  const graph = { elements: new Map(), edges: new Map() }
  addNodes(graph, store, byModule, own)
  for (const topic of store.topics.values()) {
    if (all || !isInfrastructure(topic)) addTopic(graph, topic, byModule, own)
  }
  if (!all) dropHelpers(graph, store, byModule)
  addLone(graph, store, own)
  return cut(filtered(graph, words), limit)
}

// Leave out nodes that have topics, but none that is shown: those of logs and reports.
function dropHelpers(graph, store, byModule) {
  const connected = new Set([...graph.edges.values()].flatMap(({ from, to }) => [from, to]))
  for (const { publishers = [], subscribers = [] } of store.topics.values()) {
    for (const { module, node } of [...publishers, ...subscribers]) {
      const id = nodeId(node && !byModule ? `${module}/${node}` : module ?? "")
      if (!connected.has(id) && !byModule) graph.elements.delete(id)
    }
  }
}

export function isInfrastructure(topic) {
  return Boolean(topic.is_of_service) || INFRASTRUCTURE.has(topic.name.split("/").at(-1))
}

function addNodes(graph, store, byModule, own) {
  for (const module of store.modules.values()) {
    if (own.has(module.name)) continue
    const names = byModule ? [""] : (module.nodes ?? []).map(node => node.name)
    for (const name of names) addNode(graph, module.name, name, module)
  }
}

// Add modules of which neither nodes nor topics are known.
function addLone(graph, store, own) {
  const seen = new Set([...store.topics.values()].flatMap(({ publishers = [], subscribers = [] }) => (
    [...publishers, ...subscribers].map(end => end.module))))
  for (const module of store.modules.values()) {
    if (own.has(module.name) || module.nodes?.length || seen.has(module.name)) continue
    addNode(graph, module.name, "", module)
  }
}

function addNode(graph, moduleName, name, module = null) {
  const label = name ? `${moduleName}/${name}` : moduleName
  const id = nodeId(label)
  const known = graph.elements.get(id)
  if (known) return known
  const figures = module?.nodes?.find(node => node.name === name)
  const element = {
    id, kind: "node", label, module: moduleName, node: name,
    state: figures?.running === false ? "stopped" : module?.state ?? "",
    search: [label, module?.kind ?? ""].join(" ").toLowerCase(),
  }
  graph.elements.set(id, element)
  return element
}

function addTopic(graph, topic, byModule, own) {
  const id = topicId(topic.name)
  const ends = [["publishers", "publish"], ["subscribers", "subscribe"]].flatMap(([list, role]) => (
    (topic[list] ?? []).filter(end => end.module && !own.has(end.module)).map(end => ({ ...end, role }))))
  if (!ends.length && (topic.publishers?.length || topic.subscribers?.length)) return // only this tool uses it
  graph.elements.set(id, {
    id, kind: "topic", label: topic.name, topic, search: [topic.name, topic.type ?? ""].join(" ").toLowerCase(),
  })
  for (const end of ends) addEdge(graph, topic, end, addNode(graph, end.module, byModule ? "" : end.node ?? "").id)
}

// Several publishers of a node, by several links, are one edge; of counters that are known twice the larger one is it.
function addEdge(graph, topic, end, node) {
  const [from, to] = end.role === "publish" ? [node, topicId(topic.name)] : [topicId(topic.name), node]
  const key = `${from}\n${to}`
  const unknown = { rate: null, missed: null, lost: null }
  const edge = graph.edges.get(key) ?? { key, from, to, role: end.role, topic: topic.name, ...unknown }
  edge.rate = most(edge.rate, end.rate)
  edge.missed = most(edge.missed, end.missed)
  edge.lost = most(edge.lost, end.lost && Object.values(end.lost).reduce((sum, each) => sum + each, 0))
  edge.publisherClass ??= end.publisher_class
  graph.edges.set(key, edge)
  if (edge.role === "publish" && edge.rate === null && topic.publishers.length === 1) edge.rate = topic.rate ?? null
}

function most(one, other) {
  if (other === null || other === undefined) return one
  return one === null ? other : Math.max(one, other)
}

// Keep what has all words, and its neighbours.
function filtered(graph, words) {
  if (!words.length) return graph
  const found = new Set([...graph.elements.values()]
    .filter(element => words.every(word => element.search.includes(word))).map(element => element.id))
  const edges = new Map([...graph.edges].filter(([, edge]) => found.has(edge.from) || found.has(edge.to)))
  const kept = new Set(found)
  for (const { from, to } of edges.values()) kept.add(from).add(to)
  return { elements: new Map([...graph.elements].filter(([id]) => kept.has(id))), edges }
}

function cut({ elements, edges }, limit) {
  if (elements.size <= limit) return { elements, edges, left: 0 }
  const topics = [...elements.values()].filter(element => element.kind === "topic")
  const ids = new Set()
  for (const topic of topics.sort((one, other) => (one.label < other.label ? -1 : 1))) {
    const around = [...edges.values()].filter(edge => edge.topic === topic.label).flatMap(({ from, to }) => [from, to])
    if (ids.size + around.length + 1 > limit) break
    for (const id of [topic.id, ...around]) ids.add(id)
  }
  return {
    elements: new Map([...elements].filter(([id]) => ids.has(id))),
    edges: new Map([...edges].filter(([, edge]) => ids.has(edge.from) && ids.has(edge.to))),
    left: elements.size - ids.size,
  }
}

// Return what tells whether the graph has other parts than before: its places stay as long as this does.
export function shapeOf({ elements, edges }) {
  return [...[...elements.keys()].sort(), "", ...[...edges.keys()].sort()].join("\n")
}

// Return a name with at most so many letters; the middle is left out, as names differ at their ends.
export function short(name, letters) {
  if (name.length <= letters) return name
  const end = Math.floor((letters - 1) / 2)
  return `${name.slice(0, letters - 1 - end)}…${name.slice(-end)}`
}
