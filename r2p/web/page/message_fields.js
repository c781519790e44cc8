// Fields of messages without the DOM: from what `describe` answers to a tree, and from what a user writes to values.
// r2p/web/dash/protocol.py says what a description has. Values are those of `r2p topic echo`: what a browser can't have
// as a number (a u64 beyond 2^53, not-a-number, infinities) is a text.

const INTEGER = /^([ui])(8|16|32|64)$/
const F32_MAX = 3.4028235677973366e38 // values of this size and above become infinite
const WORDS = { nan: "nan", inf: "inf", "+inf": "inf", infinity: "inf", "-inf": "-inf", "-infinity": "-inf" }
const INLINE = 16 // elements of an array that get a control each
const FORMS = 32 // messages in an array that get a form each

// Return the fields as a tree: each has its description, its `name`, and its `parts`.
export function tree(fields) {
  const root = { path: "", kind: "message", parts: [] }
  const byPath = new Map([["", root]])
  const find = path => {
    if (!byPath.has(path)) add({ path, kind: "message" })
    return byPath.get(path)
  }
  const add = field => {
    const dot = field.path.lastIndexOf(".")
    const node = { ...field, name: field.path.slice(dot + 1), parts: [] }
    byPath.set(field.path, node)
    find(dot < 0 ? "" : field.path.slice(0, dot).replace(/(\[\])+$/, "")).parts.push(node)
  }
  fields.filter(field => !field.path.endsWith("]")).forEach(add)
  return root
}

export const isArray = node => node.length !== undefined || node.max !== undefined

// Return the description of one element of an array.
export function element(node) {
  const { length, max, ...rest } = node
  return rest
}

// Return which control edits a field: "message", "messages", "bool", "enum", "number", "text", "numbers" (one for each
// element), "list" (one text for all of them), or "json" where there is nothing better.
export function controlOf(node) {
  const known = INTEGER.test(node.kind) || ["f32", "f64", "bool", "text", "message"].includes(node.kind)
  if (!known) return "json"
  if (isArray(node)) return arrayControl(node)
  if (node.kind === "message" || node.kind === "bool" || node.kind === "text") return node.kind
  return node.enum ? "enum" : "number"
}

function arrayControl(node) {
  if (node.kind === "message") return node.parts.length && (node.length ?? 0) <= FORMS ? "messages" : "json"
  if (node.kind === "text") return "json"
  return node.kind !== "bool" && node.length <= INLINE ? "numbers" : "list"
}

// Return the value of a field whose bytes are all zero.
export function zero(node) {
  if (isArray(node)) return Array.from({ length: node.length ?? 0 }, () => zero(element(node)))
  if (node.kind === "message") return Object.fromEntries(node.parts.map(part => [part.name, zero(part)]))
  return { bool: false, text: "" }[node.kind] ?? 0
}

// Return what a number may be, in words.
export function allowed(kind) {
  const [least, greatest] = limits(kind) ?? []
  return least === undefined ? "a number" : `${least} to ${greatest}`
}

function limits(kind) {
  const [, sign, bits] = kind.match(INTEGER) ?? []
  if (!sign) return null
  const half = 1n << BigInt(Number(bits) - 1)
  return sign === "i" ? [-half, half - 1n] : [0n, 2n * half - 1n]
}

// Return the number that a text stands for. Throws an Error that says what is allowed.
export function parseNumber(kind, text) {
  const trimmed = text.trim().replace(/^−/, "-")
  if (!trimmed) throw new Error(`enter ${allowed(kind)}`)
  return INTEGER.test(kind) ? parseInteger(kind, trimmed) : parseFloating(kind, trimmed)
}

function parseInteger(kind, text) {
  const [, sign, digits] = text.match(/^([+-]?)(0[xX][0-9a-fA-F]+|0[bB][01]+|\d+)$/) ?? []
  if (!digits) throw new Error(`not an integer: enter ${allowed(kind)}`)
  const value = sign === "-" ? -BigInt(digits) : BigInt(digits)
  const [least, greatest] = limits(kind)
  if (value < least || value > greatest) throw new Error(`out of range: enter ${allowed(kind)}`)
  return Number.isSafeInteger(Number(value)) ? Number(value) : String(value)
}

function parseFloating(kind, text) {
  const word = WORDS[text.toLowerCase()]
  if (word) return word
  const value = /^[+-]?(\d|\.\d)/.test(text) ? Number(text) : NaN
  if (Number.isNaN(value)) throw new Error("not a number: enter one like 0.5 or -1e-3")
  if (!Number.isFinite(value) || (kind === "f32" && Math.abs(value) >= F32_MAX)) {
    throw new Error(`too large for ${kind}`)
  }
  return value
}

// Return a text that has at most the bytes that its field takes. Throws an Error otherwise.
export function parseText(node, text) {
  const size = new TextEncoder().encode(text).length
  if (node.limit !== undefined && size > node.limit) {
    throw new Error(`${size} bytes, and the field takes ${node.limit}`)
  }
  return text
}

// Return the elements that a text stands for: "1, 2, 3", with or without brackets. Throws an Error.
export function parseList(node, text) {
  const inner = text.trim().replace(/^\[(.*)\]$/s, "$1").trim()
  const words = inner ? inner.split(/[\s,;]+/).filter(Boolean) : []
  if (node.length !== undefined && words.length !== node.length) {
    throw new Error(`${words.length} elements, and the field takes ${node.length}`)
  }
  if (node.max !== undefined && words.length > node.max) {
    throw new Error(`${words.length} elements, and the field takes at most ${node.max}`)
  }
  return words.map((word, index) => {
    try {
      return node.kind === "bool" ? parseBool(word) : parseNumber(node.kind, word)
    } catch (error) {
      throw new Error(`element ${index}: ${error.message}`)
    }
  })
}

function parseBool(word) {
  if (/^(true|1)$/i.test(word)) return true
  if (/^(false|0)$/i.test(word)) return false
  throw new Error("enter true or false")
}

// Return the elements as a user writes them. Bytes may come as base64, which is how a message has them as text.
export function showList(value) {
  if (typeof value === "string") return Array.from(atob(value), each => each.charCodeAt(0)).join(", ")
  return (value ?? []).join(", ")
}
