// Parts that the details of a topic and of a module share.

import { h, setText } from "./dom.js"
import { UNKNOWN } from "./format.js"

// Return the head of a detail: its name, which takes the keyboard, and the way back.
export function detailHead(kind, name) {
  const heading = h("h2", { tabindex: "-1" }, name)
  const close = h("a", { class: "button quiet close", href: "#/overview", "aria-label": "Close", title: "Close (Esc)" }, "×")
  return { heading, element: h("div", { class: "detail-head" }, h("p", { class: "dim" }, kind), heading, close) }
}

// A list of names and values, which changes only where these have changed.
export class FactList {
  element = h("dl", { class: "facts" })
  #values = new Map()

  // `facts` are [name, text] or [name, text, tone].
  update(facts) {
    for (const [name, text, tone] of facts) {
      if (!this.#values.has(name)) this.#add(name)
      const value = this.#values.get(name)
      setText(value, text === null || text === undefined || text === "" ? UNKNOWN : text)
      value.dataset.tone = tone ?? ""
    }
  }

  #add(name) {
    const value = h("dd")
    this.#values.set(name, value)
    this.element.append(h("dt", {}, name), value)
  }
}

// Return a small table, of rows of texts. A cell may be an element.
export function plainTable(caption, heads, rows, { numbers = [] } = {}) {
  const kind = index => numbers.includes(index) ? "number" : null
  const cell = (text, index) => index
    ? h("td", { class: kind(index) }, text ?? UNKNOWN)
    : h("th", { scope: "row" }, text ?? UNKNOWN)
  return h("table", { class: "plain" },
    h("caption", { class: "sr-only" }, caption),
    h("thead", {}, h("tr", {}, heads.map((head, index) => h("th", { scope: "col", class: kind(index) }, head)))),
    h("tbody", {}, rows.map(row => h("tr", {}, row.map(cell)))))
}

export function section(title, ...children) {
  return h("section", { class: "detail-section" }, h("h3", {}, title), ...children)
}
