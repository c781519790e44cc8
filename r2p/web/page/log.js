// The log of all modules, as it arrives: by level, source and text.

import { attempt } from "./dialogs.js"
import { button, download, field, filterBox, h, memory, oncePerFrame, pauseButton, setText } from "./dom.js"
import { clock, plural } from "./format.js"

const LEVELS = [[10, "DEBUG"], [20, "INFO"], [30, "WARNING"], [40, "ERROR"], [50, "CRITICAL"]]
const KEPT = 5_000 // records
const SHOWN = 1_000 // lines: the newest ones that the filters leave
const BOTTOM = 24 // px from the end of the list, within which it follows

export const log = {
  id: "log",
  title: "Log",
  keys: [["End", "follow the newest records"]],
  create: app => new LogView(app),
}

function levelName(level) {
  return LEVELS.findLast(([least]) => level >= least)?.[1] ?? "DEBUG"
}

// Return whether a record passes filters: {level, source, words}.
export function passes(record, { level, source, words }) {
  if (record.level < level) return false
  if (source && record.module !== source && sourceOf(record) !== source) return false
  const text = words.length ? `${sourceOf(record)} ${record.text}`.toLowerCase() : ""
  return words.every(word => text.includes(word))
}

const sourceOf = ({ module, node }) => node ? `${module}/${node}` : module

class LogView {
  #app
  #records = []
  #filters = { level: memory.get("log-level", 20), source: "", words: [] }
  #sources = new Set()
  #dropped = 0
  #paused = false
  #waiting = 0
  #following = true
  #asked = false
  #isShown = false
  #shownTo = 0 // the number of the newest record that has a line
  #number = 0
  #list = h("ol", { class: "log", role: "log", "aria-label": "Log records", "aria-live": "off", tabindex: "0" })
  #counts = h("p", { class: "dim", role: "status" })
  #lost = h("span", { class: "chip warn", hidden: true })
  #newest = button("", () => this.#toEnd(), { class: "primary newest", hidden: true })
  #unseen = 0 // lines below the end of what is in sight
  #source = h("select", { onchange: () => this.#filter({ source: this.#source.value }) },
    h("option", { value: "" }, "all"))
  #search
  #draw = oncePerFrame(() => this.#isShown && this.#append())

  constructor(app) {
    this.#app = app
    this.element = h("section", { class: "view full log-view" }, this.#bar(),
      h("div", { class: "fill log-body" }, this.#list, this.#newest))
    this.#list.addEventListener("scroll", () => this.#scrolled())
    app.connection.addEventListener("log", event => this.#receive(event.detail))
    app.connection.addEventListener("hello", () => {
      this.#asked = false
      if (this.#isShown) this.#ask()
    })
  }

  show(argument) {
    this.#isShown = true
    this.#ask()
    if (argument) this.#choose(argument)
    this.#redraw()
  }

  // Records are kept while another view is shown.
  hide() {
    this.#isShown = false
  }

  key(event) {
    if (event.key !== "End") return false
    this.#toEnd()
    return true
  }

  #ask() {
    if (this.#asked || !this.#app.hello) return
    this.#asked = true
    attempt(this.#app.connection.request("log", { level: "DEBUG" }))
  }

  #bar() {
    const level = h("select", { onchange: () => {
      memory.set("log-level", Number(level.value))
      this.#filter({ level: Number(level.value) })
    } }, LEVELS.map(([value, name]) => h("option", { value }, name.toLowerCase())))
    level.value = String(this.#filters.level)
    this.#search = filterBox("Filter the log by words", text => (
      this.#filter({ words: text.toLowerCase().split(/\s+/).filter(Boolean) })))
    return h("div", { class: "bar" }, h("h2", {}, "Log"), this.#search,
      field("From", level), field("Of", this.#source), this.#counts, this.#lost, h("span", { class: "space" }),
      pauseButton(paused => this.#pause(paused)),
      button("Clear", () => this.#clear(), { title: "Forget all records on this page" }),
      button("Save", () => this.#save(), { title: "Save the records that the filters leave as a text file" }))
  }

  // Records

  #receive({ records, dropped, cleared }) {
    if (cleared) this.#forget()
    this.#dropped = dropped ?? this.#dropped
    for (const record of records) {
      record.number = ++this.#number
      this.#records.push(record)
      this.#addSource(record)
    }
    if (this.#records.length > KEPT) this.#records.splice(0, this.#records.length - KEPT)
    if (this.#paused) this.#waiting += records.length
    if (cleared) this.#redraw()
    else this.#draw()
  }

  #forget() {
    this.#records = []
    this.#waiting = 0
  }

  #clear() {
    this.#forget()
    this.#redraw()
  }

  #addSource(record) {
    for (const name of [record.module, sourceOf(record)]) {
      if (!name || this.#sources.has(name)) continue
      this.#sources.add(name)
      const after = [...this.#source.options].slice(1).find(option => option.value > name)
      this.#source.insertBefore(h("option", { value: name }, name), after ?? null)
    }
  }

  #choose(source) {
    if (!this.#sources.has(source)) this.#source.append(h("option", { value: source }, source))
    this.#sources.add(source)
    this.#source.value = source
    this.#filters.source = source
  }

  #filter(changes) {
    Object.assign(this.#filters, changes)
    this.#redraw()
  }

  #pause(paused) {
    this.#paused = paused
    this.#waiting = 0
    if (!paused) this.#redraw()
    this.#say()
  }

  #save() {
    const lines = this.#records.filter(record => passes(record, this.#filters)).map(record => (
      `${new Date(record.time / 1e6).toISOString()} ${levelName(record.level)} ${sourceOf(record)}: ${record.text}\n`))
    download("log.txt", lines, "text/plain")
  }

  // Lines

  #redraw() {
    this.#list.replaceChildren()
    this.#shownTo = 0
    this.#unseen = 0
    this.#append({ all: true })
  }

  #append({ all = false } = {}) {
    if (!this.#paused || all) this.#addLines()
    if (this.#following) this.#list.scrollTop = this.#list.scrollHeight
    this.#say()
  }

  #addLines() {
    const fresh = []
    for (let i = this.#records.length - 1; i >= 0 && fresh.length < SHOWN; i--) {
      const record = this.#records[i]
      if (record.number <= this.#shownTo) break
      if (passes(record, this.#filters)) fresh.push(record)
    }
    this.#shownTo = this.#number
    this.#list.append(...fresh.reverse().map(line))
    const extra = this.#list.children.length - SHOWN
    const before = this.#list.scrollHeight
    for (let i = 0; i < extra; i++) this.#list.firstChild.remove()
    if (extra > 0 && !this.#following) this.#list.scrollTop -= before - this.#list.scrollHeight
    if (!this.#following) this.#unseen += fresh.length
  }

  #say() {
    const passed = this.#records.reduce((sum, record) => sum + passes(record, this.#filters), 0)
    const waiting = this.#paused && this.#waiting ? ` · ${this.#waiting} since the pause` : ""
    setText(this.#counts, this.#records.length
      ? `${passed} of ${plural(this.#records.length, "record")}${waiting}`
      : "No records yet: nothing keeps those of before this page")
    this.#lost.hidden = !this.#dropped
    setText(this.#lost, `${this.#dropped} lost`)
    this.#lost.title = "Records that were lost before this page had them"
    this.#newest.hidden = this.#following
    setText(this.#newest, this.#unseen ? `↓ ${this.#unseen} new` : "↓ Follow")
    Object.assign(this.element.dataset, { records: this.#records.length, shown: this.#list.children.length })
  }

  #scrolled() {
    const { scrollTop, clientHeight, scrollHeight } = this.#list
    const following = scrollTop + clientHeight >= scrollHeight - BOTTOM
    if (following === this.#following) return
    this.#following = following
    if (following) this.#unseen = 0
    this.#say()
  }

  #toEnd() {
    this.#list.scrollTop = this.#list.scrollHeight
    this.#following = true
    this.#unseen = 0
    this.#say()
  }
}

function line(record) {
  const level = levelName(record.level)
  return h("li", { class: `record ${level.toLowerCase()}`, dataset: { level } },
    h("time", { datetime: new Date(record.time / 1e6).toISOString() }, clock(record.time / 1e9, 3)),
    h("span", { class: "level" }, level),
    h("span", { class: "source" }, sourceOf(record)),
    h("span", { class: "text" }, record.text))
}
