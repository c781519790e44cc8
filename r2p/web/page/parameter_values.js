// Values of parameters and texts of them, without the DOM. `ParameterInfo` of r2p says what a parameter has.

import { parseList, parseNumber } from "./message_fields.js"

const ITEMS = { ints: { kind: "i64" }, floats: { kind: "f64" } }

// Return the value that a text stands for. Throws an Error that says what is allowed.
export function parseValue(parameter, text) {
  const value = parsed(parameter, text)
  for (const each of Array.isArray(value) ? value : [value]) checkLimits(parameter, each)
  return value
}

function parsed(parameter, text) {
  if (parameter.kind in ITEMS) return parseList(ITEMS[parameter.kind], text)
  if (parameter.kind === "int") return parseNumber("i64", text)
  return parameter.kind === "float" ? parseNumber("f64", text) : text
}

function checkLimits({ minimum, maximum, unit }, value) {
  const of = limit => `${limit}${unit ? ` ${unit}` : ""}`
  if (isLimit(minimum) && value < minimum) throw new Error(`it takes ${of(minimum)} or more`)
  if (isLimit(maximum) && value > maximum) throw new Error(`it takes ${of(maximum)} or less`)
}

const isLimit = limit => limit !== null && limit !== undefined

// Return what a value is allowed to be, in words; "" for all.
export function limitsText({ minimum, maximum }) {
  if (isLimit(minimum) && isLimit(maximum)) return `${minimum} to ${maximum}`
  if (isLimit(minimum)) return `${minimum} or more`
  return isLimit(maximum) ? `${maximum} or less` : ""
}

export function valueText(value) {
  if (value === null || value === undefined) return ""
  return Array.isArray(value) ? value.join(", ") : String(value)
}

export function isSame(one, other) {
  return JSON.stringify(one) === JSON.stringify(other)
}

// Return what is to be known of where a value comes from, and of what is saved: a list of {text, tone}.
export function notesOf(parameter) {
  const notes = []
  if (parameter.problem) notes.push({ text: `saved value is not used: ${parameter.problem}`, tone: "bad" })
  const isSaved = parameter.saved !== null && parameter.saved !== undefined
  if (isSaved && !parameter.problem && !isSame(parameter.saved, parameter.value)) {
    notes.push({ text: `saved: ${valueText(parameter.saved)}`, tone: "warn" })
  }
  if (!isSaved && parameter.origin === "run time") notes.push({ text: "not saved", tone: "warn" })
  notes.push({ text: `from ${parameter.origin}`, tone: "dim" })
  return notes
}

// Return the parameter that an error names, "MODULE/NODE.NAME = VALUE: why", of those of a node; or null.
export function blamed(text, module, node, names) {
  return [...names].sort((one, other) => other.length - one.length)
    .find(name => text.includes(`${module}/${node}.${name} `) || text.includes(`${node}.${name} `)
      || text.includes(`${node}.${name}:`)) ?? null
}

// Return the nodes of a module with their parameters: a list of [node, parameters], by name.
export function byNode(parameters) {
  const nodes = new Map()
  for (const parameter of parameters) {
    if (!nodes.has(parameter.node)) nodes.set(parameter.node, [])
    nodes.get(parameter.node).push(parameter)
  }
  const compare = (one, other) => (one < other ? -1 : one > other ? 1 : 0)
  for (const list of nodes.values()) list.sort((one, other) => compare(one.name, other.name))
  return [...nodes].sort(([one], [other]) => compare(one, other))
}
