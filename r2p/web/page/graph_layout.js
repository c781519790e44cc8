// The places of nodes and topics in the graph: layers from left to right, or from top to bottom, as the messages go.
//
// The same graph always has the same places, whatever the order in which its parts are given: rates and counters don't
// take part, so nothing jumps when they change. Edges that close a circle are taken backwards, long ones go through
// points in the layers between, and sweeps over the layers bring neighbours to the same height.

const LAYER_GAP = { right: 92, down: 56 } // px: room for the text of an edge
const ROW_GAP = { right: 14, down: 22 } // px
const PART_GAP = 44 // px between parts that are not connected
const ROWS_MAX = 40 // arrangements that are tried for each direction
const BEND_HEIGHT = 10 // px that an edge takes in a layer that it crosses
const SWEEPS = 8
const SETTLES = 12

// Return {places: Map of id to {x, y, width, height, layer}, routes: Map of edge key to points, width, height, way}.
// `nodes` are {id, width, height}, `edges` {from, to}; the key of an edge is edgeKey(edge). `way` is "right" or "down":
// parts that are not connected are arranged so that all of it is as large as it can be in an `area` {width, height}.
export function arrange(nodes, edges, area) {
  const kept = withoutDangling(nodes, edges)
  const components = componentsOf(nodes, kept)
  const candidates = ["right", "down"].flatMap(way => {
    const parts = components.map(part => layout(part.nodes, part.edges, way))
    let sum = 0
    const widths = parts.map(part => (sum += part.width + PART_GAP))
    return [...new Set([...widths.slice(0, ROWS_MAX), widths.at(-1)])].map(width => ({ way, ...pack(parts, width) }))
  })
  const scale = ({ width, height }) => Math.min(area.width / Math.max(1, width), area.height / Math.max(1, height))
  return candidates.reduce((best, each) => (scale(each) > scale(best) * 1.001 ? each : best))
}

function withoutDangling(nodes, edges) {
  const known = new Set(nodes.map(node => node.id))
  return unique(edges.filter(edge => edge.from !== edge.to && known.has(edge.from) && known.has(edge.to)))
}

// Return the connected parts of a graph, the largest first.
function componentsOf(nodes, edges) {
  const near = new Map(nodes.map(node => [node.id, []]))
  for (const { from, to } of edges) {
    near.get(from).push(to)
    near.get(to).push(from)
  }
  const partOf = new Map()
  const sorted = [...nodes].sort((one, other) => compare(one.id, other.id))
  for (const { id } of sorted) {
    const reached = partOf.has(id) ? [] : [id]
    for (const each of reached) {
      if (partOf.has(each)) continue
      partOf.set(each, id)
      reached.push(...near.get(each))
    }
  }
  const parts = new Map()
  for (const node of sorted) {
    const first = partOf.get(node.id)
    if (!parts.has(first)) parts.set(first, { first, nodes: [], edges: [] })
    parts.get(first).nodes.push(node)
  }
  for (const edge of edges) parts.get(partOf.get(edge.from)).edges.push(edge)
  const size = part => part.nodes.length
  return [...parts.values()].sort((one, other) => size(other) - size(one) || compare(one.first, other.first))
}

// Put parts beside each other, in rows of at most a width.
function pack(parts, width) {
  const packed = { places: new Map(), routes: new Map(), width: 0, height: 0 }
  let [x, y, rowHeight] = [0, 0, 0]
  for (const part of parts) {
    if (x && x + part.width > width) [x, y, rowHeight] = [0, y + rowHeight + PART_GAP, 0]
    shift(part, x, y, packed)
    rowHeight = Math.max(rowHeight, part.height)
    packed.width = Math.max(packed.width, x + part.width)
    packed.height = Math.max(packed.height, y + part.height)
    x += part.width + PART_GAP
  }
  return packed
}

function shift({ places, routes }, dx, dy, { places: allPlaces, routes: allRoutes }) {
  for (const [id, place] of places) allPlaces.set(id, { ...place, x: place.x + dx, y: place.y + dy })
  for (const [key, points] of routes) allRoutes.set(key, points.map(({ x, y }) => ({ x: x + dx, y: y + dy })))
}

// Lay out connected nodes in one direction; returns what `arrange` does.
export function layout(nodes, edges, way = "right") {
  if (way === "right") return layoutRight(nodes, edges, way)
  const turned = layoutRight(nodes.map(node => ({ ...node, width: node.height, height: node.width })), edges, way)
  const turn = ({ x, y, width, height, ...rest }) => ({ ...rest, x: y, y: x, width: height, height: width })
  const point = ({ x, y }) => ({ x: y, y: x })
  return {
    places: new Map([...turned.places].map(([id, place]) => [id, turn(place)])),
    routes: new Map([...turned.routes].map(([key, points]) => [key, points.map(point)])),
    width: turned.height,
    height: turned.width,
  }
}

function layoutRight(nodes, edges, way) {
  const sorted = [...nodes].sort((one, other) => compare(one.id, other.id))
  const kept = withoutDangling(sorted, edges)
  const forward = withoutCircles(sorted, kept)
  const layerOf = layers(sorted, forward)
  const graph = withBends(sorted, forward, layerOf)
  order(graph)
  settle(graph, ROW_GAP[way])
  return measure(graph, kept, forward, LAYER_GAP[way])
}

export const edgeKey = edge => `${edge.from}\n${edge.to}`

const compare = (one, other) => (one < other ? -1 : one > other ? 1 : 0)

function unique(edges) {
  const byKey = new Map(edges.map(edge => [edgeKey(edge), edge]))
  return [...byKey.keys()].sort(compare).map(key => byKey.get(key))
}

function listsOf(nodes, edges, from, to) {
  const lists = new Map(nodes.map(node => [node.id, []]))
  for (const edge of edges) lists.get(edge[from]).push(edge[to])
  return lists
}

// Turn around the edges that lead back into a path from which they come. Without recursion: paths can be long.
function withoutCircles(nodes, edges) {
  const next = listsOf(nodes, edges, "from", "to")
  const incoming = listsOf(nodes, edges, "to", "from")
  const state = new Map()
  const back = new Set()
  const starts = [...nodes].sort((one, other) => incoming.get(one.id).length - incoming.get(other.id).length)
  for (const { id } of starts) {
    if (state.has(id)) continue
    const path = [{ id, at: 0 }]
    state.set(id, "open")
    while (path.length) {
      const step = path[path.length - 1]
      const to = next.get(step.id)[step.at++]
      if (to === undefined) state.set(path.pop().id, "done")
      else if (state.get(to) === "open") back.add(edgeKey({ from: step.id, to }))
      else if (!state.has(to)) {
        state.set(to, "open")
        path.push({ id: to, at: 0 })
      }
    }
  }
  return edges.map(edge => back.has(edgeKey(edge)) ? { from: edge.to, to: edge.from, turned: true } : edge)
}

// Return the layer of each node: one more than that of the last one before it. What nothing leads to moves right,
// next to what it leads to.
function layers(nodes, edges) {
  const next = listsOf(nodes, edges, "from", "to")
  const missing = new Map(nodes.map(node => [node.id, 0]))
  for (const edge of edges) missing.set(edge.to, missing.get(edge.to) + 1)
  const layerOf = new Map(nodes.map(node => [node.id, 0]))
  const sources = nodes.filter(node => !missing.get(node.id)).map(node => node.id)
  const ready = [...sources]
  for (let at = 0; at < ready.length; at++) {
    for (const to of next.get(ready[at])) {
      layerOf.set(to, Math.max(layerOf.get(to), layerOf.get(ready[at]) + 1))
      missing.set(to, missing.get(to) - 1)
      if (!missing.get(to)) ready.push(to)
    }
  }
  for (const id of sources) {
    if (next.get(id).length) layerOf.set(id, Math.min(...next.get(id).map(to => layerOf.get(to))) - 1)
  }
  return layerOf
}

// Give long edges a bend in each layer that they cross, so that all edges lead from one layer to the next.
function withBends(nodes, edges, layerOf) {
  const rows = []
  const place = (item, layer) => {
    rows[layer] ??= []
    rows[layer].push(item)
    return item
  }
  const items = new Map()
  for (const node of nodes) {
    const layer = layerOf.get(node.id)
    items.set(node.id, place({ ...node, layer, before: [], after: [], y: 0 }, layer))
  }
  const chains = new Map()
  for (const edge of edges) {
    const chain = [items.get(edge.from)]
    for (let layer = layerOf.get(edge.from) + 1; layer < layerOf.get(edge.to); layer++) {
      chain.push(place({ layer, width: 0, height: BEND_HEIGHT, before: [], after: [], y: 0 }, layer))
    }
    chain.push(items.get(edge.to))
    chain.slice(1).forEach((item, index) => {
      item.before.push(chain[index])
      chain[index].after.push(item)
    })
    chains.set(edge, chain)
  }
  return { rows: Array.from(rows, row => row ?? []), items, chains }
}

// Sort each layer by the middle of the neighbours in the one before, then in the one behind, and so on; the order with
// the fewest crossings stays.
function order({ rows }) {
  const number = row => row.forEach((item, index) => { item.index = index })
  rows.forEach(number)
  let best = rows.map(row => [...row])
  let fewest = crossings(rows)
  for (let sweep = 0; sweep < SWEEPS && fewest; sweep++) {
    const down = sweep % 2 === 0
    for (const row of down ? rows : [...rows].reverse()) {
      for (const item of row) item.middle = mean(down ? item.before : item.after, each => each.index, item.index)
      row.sort((one, other) => one.middle - other.middle || one.index - other.index)
      number(row)
    }
    const now = crossings(rows)
    if (now >= fewest) continue
    fewest = now
    best = rows.map(row => [...row])
  }
  rows.forEach((row, index) => {
    row.splice(0, row.length, ...best[index])
    number(row)
  })
}

function mean(items, value, otherwise) {
  return items.length ? items.reduce((sum, item) => sum + value(item), 0) / items.length : otherwise
}

// Count crossings: pairs of edges whose ends are in opposite order, by merging as in a sort.
function crossings(rows) {
  return rows.reduce((sum, row) => {
    const ends = row.flatMap(item => item.after.map(each => each.index).sort((one, other) => one - other))
    return sum + inversions(ends)
  }, 0)
}

function inversions(values) {
  if (values.length < 2) return 0
  const half = values.length >> 1
  const left = values.slice(0, half)
  const right = values.slice(half)
  let found = inversions(left) + inversions(right)
  let at = 0
  let to = 0
  for (let i = 0; i < values.length; i++) {
    const takesRight = at === left.length || (to < right.length && right[to] < left[at])
    if (takesRight) found += left.length - at
    values[i] = takesRight ? right[to++] : left[at++]
  }
  return found
}

// Move the items of each layer towards the height of their neighbours, in their order and with gaps between them.
function settle({ rows }, rowGap) {
  for (const row of rows) {
    let y = 0
    for (const item of row) {
      item.y = y + item.height / 2
      y += item.height + rowGap
    }
  }
  for (let round = 0; round < SETTLES; round++) {
    for (const row of round % 2 ? [...rows].reverse() : rows) {
      const sides = round % 2 ? item => item.after : item => item.before
      align(row, row.map(item => mean(round === SETTLES - 1 ? [...item.before, ...item.after] : sides(item),
        each => each.y, item.y)), rowGap)
    }
  }
}

// Give items the nearest heights to those wanted: blocks of items that touch share the mean of what they want.
function align(row, wanted, rowGap) {
  const blocks = []
  row.forEach((item, index) => {
    let block = { items: [item], offset: [0], sum: wanted[index], height: 0 }
    while (blocks.length) {
      const last = blocks[blocks.length - 1]
      const gap = (last.items.at(-1).height + block.items[0].height) / 2 + rowGap
      if (last.sum / last.items.length + last.height + gap <= block.sum / block.items.length) break
      blocks.pop()
      block = joined(last, block, last.height + gap)
    }
    blocks.push(block)
  })
  for (const block of blocks) {
    block.items.forEach((item, index) => { item.y = block.sum / block.items.length + block.offset[index] })
  }
}

function joined(first, second, shift) {
  return {
    items: [...first.items, ...second.items],
    offset: [...first.offset, ...second.offset.map(each => each + shift)],
    sum: first.sum + second.sum - shift * second.items.length,
    height: shift + second.height,
  }
}

function measure({ rows, items, chains }, edges, forward, layerGap) {
  const widths = rows.map(row => Math.max(0, ...row.map(item => item.width)))
  const lefts = widths.map((_, index) => widths.slice(0, index).reduce((sum, width) => sum + width + layerGap, 0))
  const all = rows.flat()
  const top = Math.min(0, ...all.map(item => item.y - item.height / 2))
  const x = item => lefts[item.layer] + widths[item.layer] / 2
  const places = new Map([...items].map(([id, { width, height, layer, y }]) => [
    id, { x: x({ layer }), y: y - top, width, height, layer },
  ]))
  const routes = new Map(forward.map((edge, index) => [
    edgeKey(edges[index]), route(chains.get(edge), edge.turned, x, top, widths),
  ]))
  const height = Math.max(0, ...all.map(item => item.y + item.height / 2)) - top
  return { places, routes, width: lefts.length ? lefts.at(-1) + widths.at(-1) : 0, height }
}

// Return the points of an edge from the side of its publisher to that of its subscriber. In a layer that it crosses it
// goes straight on, from the left of the widest box there to the right.
function route(chain, turned, x, top, widths) {
  const points = chain.flatMap((item, index) => {
    const half = (index === 0 || index === chain.length - 1 ? item.width : widths[item.layer]) / 2
    const point = side => ({ x: x(item) + side * half, y: item.y - top })
    if (index === 0) return [point(1)]
    return index === chain.length - 1 ? [point(-1)] : [point(-1), point(1)]
  })
  return turned ? points.reverse() : points
}
