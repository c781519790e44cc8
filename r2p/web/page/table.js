// Tables of live figures: sorted by a click on a head, filtered, and changed only where something has changed.

import { button, h, memory, place, setText } from "./dom.js"
import { UNKNOWN } from "./format.js"

const ROWS = 400 // shown before one asks for the rest: a browser lays out thousands slowly

// A table. `columns` are objects with
//   id, title, unit, hint     its head: unit in dim letters, hint as its title
//   value(row)                what it is sorted by: a number, a text, or null where it is not known
//   text(row)                 what is shown; without it the value, or "-"
//   tone(row)                 a class for the cell: "bad", "warn", "good", "dim" or ""; optional
//   link(row)                 the address that the cell opens; optional
//   draw(cell, row)           draws the cell itself, instead of text; optional
//   number                    true: aligned right
//   level                     1 is shown always, 2, 3 and 4 only where the table is wide enough
// The first column names the row. `key(row)` is unique. `sort` is the id of a column, "-" before it: largest first.
export class LiveTable {
  #columns
  #key
  #search
  #sort
  #id
  #rows = []
  #shown = new Map()
  #words = []
  #limit = ROWS
  #body = h("tbody")
  #empty = h("p", { class: "empty" })
  #more
  #emptyText

  constructor({ id, caption, columns, key, sort, search, empty = "Nothing here" }) {
    this.#id = id
    this.#columns = columns
    this.#key = key
    this.#search = search ?? key
    this.#emptyText = empty
    this.#sort = readSort(memory.get(`sort-${id}`, sort) ?? columns[0].id, columns)
    this.#more = button("", () => this.#showAll(), { class: "quiet more", hidden: true })
    const heads = columns.map(column => this.#head(column))
    this.element = h("div", { class: "table-box" },
      h("table", { class: "live" },
        h("caption", { class: "sr-only" }, caption), h("thead", {}, h("tr", {}, heads)), this.#body),
      this.#empty, this.#more)
    this.#body.addEventListener("keydown", moveFocus)
    this.#markSort()
  }

  // How many rows the filter leaves, of how many.
  get counts() {
    return { shown: this.#filtered().length, all: this.#rows.length }
  }

  // Show rows, in any order. A row that is the same object as before is not drawn again.
  update(rows) {
    this.#rows = [...rows]
    this.#draw()
  }

  // Show the rows that have all words of a text.
  filter(text) {
    this.#words = text.toLowerCase().split(/\s+/).filter(Boolean)
    this.#draw()
  }

  #filtered() {
    if (!this.#words.length) return this.#rows
    return this.#rows.filter(row => {
      const text = this.#search(row).toLowerCase()
      return this.#words.every(word => text.includes(word))
    })
  }

  #head(column) {
    const unit = column.unit ? h("span", { class: "unit" }, column.unit) : null
    const title = h("span", { class: column.titleHidden ? "sr-only" : null }, column.title)
    const head = button("", () => this.#sortBy(column), { title: column.hint })
    head.append(title, ...(unit ? [" ", unit] : []))
    return h("th", { scope: "col", class: classes(column), dataset: { column: column.id } }, head)
  }

  #sortBy(column) {
    const same = this.#sort.column === column
    this.#sort = { column, down: same ? !this.#sort.down : Boolean(column.number) }
    memory.set(`sort-${this.#id}`, (this.#sort.down ? "-" : "") + column.id)
    this.#markSort()
    this.#draw()
  }

  #markSort() {
    for (const head of this.element.querySelectorAll("th[data-column]")) {
      if (head.dataset.column !== this.#sort.column.id) head.removeAttribute("aria-sort")
      else head.setAttribute("aria-sort", this.#sort.down ? "descending" : "ascending")
    }
  }

  #showAll() {
    this.#limit = Infinity
    this.#draw()
  }

  #draw() {
    const filtered = this.#filtered()
    const rows = sorted(filtered, this.#sort, this.#key).slice(0, this.#limit)
    const focused = document.activeElement
    this.#place(rows)
    if (focused !== document.activeElement && this.#body.contains(focused)) focused.focus({ preventScroll: true })
    this.#empty.hidden = rows.length > 0
    setText(this.#empty, this.#words.length ? "Nothing matches the filter" : this.#emptyText)
    this.#more.hidden = filtered.length <= rows.length
    setText(this.#more, `Show ${filtered.length - rows.length} more`)
  }

  #place(rows) {
    const before = this.#shown
    this.#shown = new Map()
    for (const row of rows) {
      const key = this.#key(row)
      const line = before.get(key) ?? this.#line()
      this.#shown.set(key, line)
      if (line.row !== row) this.#fill(line, row)
    }
    place(this.#body, [...this.#shown.values()].map(line => line.element))
  }

  #line() {
    const cells = this.#columns.map((column, index) => index === 0
      ? h("th", { scope: "row", class: classes(column) })
      : h("td", { class: classes(column) }))
    return { row: null, element: h("tr", {}, cells), cells }
  }

  #fill(line, row) {
    line.row = row
    this.#columns.forEach((column, index) => fill(line.cells[index], column, row))
  }
}

function fill(cell, column, row) {
  if (column.tone) cell.dataset.tone = column.tone(row) ?? ""
  if (column.draw) return column.draw(cell, row)
  const text = (column.text ? column.text(row) : column.value(row)) ?? UNKNOWN
  if (!column.link) return setText(cell, text)
  const link = cell.firstChild ?? cell.appendChild(h("a"))
  const address = column.link(row)
  if (link.getAttribute("href") !== address) link.setAttribute("href", address)
  setText(link, text)
  link.title = text
}

function classes(column) {
  return [column.number ? "number" : "text", `level-${column.level ?? 1}`].join(" ")
}

function readSort(text, columns) {
  const down = text.startsWith("-")
  const column = columns.find(each => each.id === text.slice(down ? 1 : 0)) ?? columns[0]
  return { column, down }
}

// What is not known comes last in both directions; rows of the same value keep the order of their names.
function sorted(rows, { column, down }, key) {
  const entries = rows.map(row => ({ row, value: column.value(row) ?? null, name: key(row) }))
  const sign = down ? -1 : 1
  entries.sort((one, other) => compare(one, other, sign))
  return entries.map(entry => entry.row)
}

function compare(one, other, sign) {
  if (one.value === null || other.value === null) {
    if (one.value !== other.value) return one.value === null ? 1 : -1
  } else if (one.value !== other.value) {
    return sign * (typeof one.value === "string" ? byName.compare(one.value, other.value) : one.value - other.value)
  }
  return byName.compare(one.name, other.name)
}

const byName = new Intl.Collator(undefined, { numeric: true })

function moveFocus(event) {
  const step = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[event.key]
  const link = step && event.target.closest("tr")?.[step]?.querySelector("a, button")
  if (!link) return
  event.preventDefault()
  link.focus()
}
