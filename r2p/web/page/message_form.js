// A form for a message, made from the description of its type: each field has the control that fits it.

import { button, h } from "./dom.js"
import {
  controlOf, element, isArray, parseList, parseNumber, parseText, showList, tree, zero,
} from "./message_fields.js"

const LONG_TEXT = 120 // bytes; a field that takes more gets several lines
const MANY = 1 << 20 // elements or bytes: a limit of more is one of the network, and says nothing to a user

let ids = 0

// A form for values of the type that `description` describes. `read()` returns the value, or null after it has marked
// what is wrong; `write(value)` shows one.
export class MessageForm {
  #root
  #controls = [] // all that can be wrong: {path, input, fail(text)}
  #zero

  constructor(description) {
    const root = tree(description.fields)
    this.#zero = description.zero ?? zero(root)
    this.#root = parts(root, "", this.#controls)
    this.element = h("div", { class: "message-form" }, root.parts.length
      ? this.#root.elements
      : h("p", { class: "dim" }, "This message has no fields."))
    this.reset()
  }

  reset() {
    this.write(this.#zero)
  }

  write(value) {
    this.#root.write(value)
    this.#clean()
  }

  read() {
    this.#clean()
    const value = this.#root.read()
    const first = this.#controls.find(control => control.input.getAttribute("aria-invalid") === "true")
    first?.input.focus()
    return first ? null : value
  }

  // Show the error of a process at the field that it names; return whether there is such a field.
  blame(text) {
    const named = this.#controls.filter(control => control.input.isConnected && names(text, control.path))
    const control = named.sort((one, other) => other.path.length - one.path.length)[0]
    control?.fail(text)
    control?.input.focus()
    return control !== undefined
  }

  disable(disabled) {
    for (const each of this.element.querySelectorAll("input, select, textarea, button")) each.disabled = disabled
  }

  #clean() {
    this.#controls = this.#controls.filter(control => this.element.contains(control.input))
    for (const control of this.#controls) control.fail("")
  }
}

// Return whether an error names a path: "speed.value[1] = 3.5e39: ...".
function names(text, path) {
  const at = text.indexOf(path)
  return at >= 0 && !/[\w.]/.test(text[at + path.length] ?? " ") && !/\w/.test(text[at - 1] ?? " ")
}

// Return the part of a form for a field at a path: {elements, read(), write(value)}.
function part(node, path, controls) {
  const make = { message: group, messages: list, numbers: row, bool, enum: choice, json }[controlOf(node)] ?? text
  return make(node, path, controls)
}

function parts(node, path, controls) {
  const inner = node.parts.map(each => [each.name, part(each, path ? `${path}.${each.name}` : each.name, controls)])
  return {
    elements: inner.flatMap(([, each]) => each.elements),
    read: () => Object.fromEntries(inner.map(([name, each]) => [name, each.read()])),
    write: value => inner.forEach(([name, each]) => each.write(value?.[name])),
  }
}

function group(node, path, controls) {
  const inner = parts(node, path, controls)
  const element = h("fieldset", { class: "group" }, h("legend", {}, node.name), inner.elements)
  return { ...inner, elements: [element] }
}

// A control with its label, and room for what is wrong with it.
function labelled(node, path, input, controls, hint = node.kind) {
  input.id = `field-${++ids}`
  input.dataset.field = path
  const error = h("p", { class: "error", id: `${input.id}-error`, hidden: true })
  input.setAttribute("aria-describedby", error.id)
  const fail = message => {
    error.textContent = message
    error.hidden = !message
    if (message) input.setAttribute("aria-invalid", "true")
    else input.removeAttribute("aria-invalid")
  }
  controls.push({ path, input, fail })
  const label = h("label", { for: input.id }, node.name, " ", h("span", { class: "unit" }, hint))
  return { fail, elements: [h("div", { class: "form-row" }, label, input, error)] }
}

function reader(input, fail, parse) {
  return () => {
    try {
      return parse(input.value)
    } catch (error) {
      fail(error.message)
      return null
    }
  }
}

// Numbers are written into text fields: those of browsers lose integers beyond 2^53, and have no not-a-number.
function text(node, path, controls) {
  const [parse, show, hint] = wayOf(node)
  const long = (node.kind === "text" && node.limit > LONG_TEXT) || isArray(node)
  const input = h(long ? "textarea" : "input", {
    autocomplete: "off", spellcheck: "false", rows: long ? 2 : null,
    inputmode: node.kind === "text" || isArray(node) ? null : "text",
    class: node.kind === "text" ? "wide" : isArray(node) ? "wide mono" : "number",
  })
  const { fail, elements } = labelled(node, path, input, controls, hint)
  input.addEventListener("input", () => fail(""))
  return { elements, read: reader(input, fail, parse), write: value => { input.value = show(value) } }
}

function wayOf(node) {
  if (isArray(node)) {
    return [value => parseList(node, value), showList, `${node.kind}${countOf(node)}`]
  }
  if (node.kind === "text") return [value => parseText(node, value), value => value ?? "", sizeOf(node)]
  return [value => parseNumber(node.kind, value), value => String(value ?? 0), node.kind]
}

const sizeOf = node => node.limit === undefined || node.limit >= MANY ? "text" : `text ≤ ${node.limit} B`

const countOf = node => `[${node.length ?? (node.max >= MANY ? "" : `≤ ${node.max}`)}]`

function bool(node, path, controls) {
  const input = h("input", { type: "checkbox" })
  const { elements } = labelled(node, path, input, controls)
  return { elements, read: () => input.checked, write: value => { input.checked = Boolean(value) } }
}

// Named values; another one stays as it is.
function choice(node, path, controls) {
  const input = h("select")
  const named = Object.entries(node.enum)
  const { elements } = labelled(node, path, input, controls)
  const write = value => {
    const wanted = value ?? 0
    const other = named.some(([, each]) => each === wanted) ? [] : [["", wanted]]
    input.replaceChildren(...[...named, ...other].map(([name, each]) => (
      h("option", { value: String(each) }, `${name} ${each}`.trim()))))
    input.value = String(wanted)
  }
  return { elements, read: () => parseNumber(node.kind, input.value), write }
}

// A field for each of a few numbers.
function row(node, path, controls) {
  const item = element(node)
  const inner = Array.from({ length: node.length }, (_, index) => (
    part({ ...item, name: `[${index}]` }, `${path}[${index}]`, controls)))
  const legend = h("legend", {}, node.name, " ", h("span", { class: "unit" }, `${node.kind}[${node.length}]`))
  const box = h("fieldset", { class: "group numbers" }, legend, inner.flatMap(each => each.elements))
  return {
    elements: [box],
    read: () => inner.map(each => each.read()),
    write: value => inner.forEach((each, index) => each.write(value?.[index])),
  }
}

// A form for each message of an array; where their number varies, they can be added and taken away.
function list(node, path, controls) {
  const item = element(node)
  const box = h("div", { class: "items" })
  let inner = []
  const add = button("Add", () => grow(zero(item)), { class: "quiet", hidden: node.length !== undefined })
  const check = () => { add.disabled = inner.length >= (node.length ?? node.max) }
  const grow = value => {
    const made = group({ ...item, name: `${node.name}[${inner.length}]` }, `${path}[${inner.length}]`, controls)
    made.write(value)
    inner.push(made)
    box.append(...made.elements)
    check()
  }
  const remove = button("Remove the last", () => {
    inner.pop()?.elements.forEach(each => each.remove())
    check()
  }, { class: "quiet", hidden: node.length !== undefined })
  const legend = h("legend", {}, node.name, " ", h("span", { class: "unit" }, countOf(node)))
  return {
    elements: [h("fieldset", { class: "group" }, legend, box, h("div", { class: "actions" }, add, remove))],
    read: () => inner.map(each => each.read()),
    write: value => {
      inner = []
      box.replaceChildren()
      for (const each of value ?? []) grow(each)
      check()
    },
  }
}

// What has no better control, such as an array of texts.
function json(node, path, controls) {
  const input = h("textarea", { class: "wide mono", rows: 2, spellcheck: "false" })
  const { fail, elements } = labelled(node, path, input, controls, "JSON")
  const parse = value => {
    try {
      return JSON.parse(value)
    } catch (error) {
      throw new Error(`not valid JSON: ${error.message}`)
    }
  }
  return { elements, read: reader(input, fail, parse), write: value => { input.value = JSON.stringify(value ?? null) } }
}

