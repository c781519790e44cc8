// The parameters of all modules and nodes: read, set, taken back and saved.

import { attempt, toast } from "./dialogs.js"
import { button, filterBox, h, place, setText } from "./dom.js"
import { plural } from "./format.js"
import { blamed, byNode, isSame, limitsText, notesOf, parseValue, valueText } from "./parameter_values.js"

const AT_ONCE = 4 // modules that are asked at the same time
const ASK_AGAIN = 5_000 // ms after which one that did not answer is asked again

export const parameters = {
  id: "parameters",
  title: "Parameters",
  keys: [["Enter", "set the changed parameters of a node"]],
  create: app => new ParametersView(app),
}

class ParametersView {
  #app
  #modules = new Map() // ModuleParameters by name
  #queue = []
  #running = 0
  #soon = null // a timer
  #words = []
  #list = h("div", { class: "stack" })
  #empty = h("p", { class: "empty" })
  #hint = h("p", { class: "hint", hidden: true },
    "Parameters can't be set here: start r2p dash with --allow-control to change them from this page.")
  #filter
  #find = () => this.#findModules()

  constructor(app) {
    this.#app = app
    this.#filter = filterBox("Filter parameters", text => {
      this.#words = text.toLowerCase().split(/\s+/).filter(Boolean)
      this.#show()
    })
    this.element = h("section", { class: "view parameters-view" },
      h("div", { class: "bar" }, h("h2", {}, "Parameters"), this.#filter, h("span", { class: "space" }),
        button("Read again", () => this.#readAll(), { title: "Ask all modules for their parameters again" })),
      this.#hint, this.#empty, this.#list)
    app.connection.addEventListener("hello", () => this.element.isConnected && this.#readAll())
    app.connection.addEventListener("clock", () => this.#readSoon())
  }

  show(argument) {
    this.#app.store.addEventListener("change", this.#find)
    if (argument) {
      this.#filter.value = argument
      this.#words = argument.toLowerCase().split(/\s+/).filter(Boolean)
    }
    this.#readAll()
  }

  hide() {
    this.#app.store.removeEventListener("change", this.#find)
  }

  // Of a recording they are as they were, so its time has them read again.
  #readSoon() {
    if (this.#soon || !this.element.isConnected) return
    this.#soon = setTimeout(() => {
      this.#soon = null
      this.#readAll()
    }, 500)
  }

  #readAll() {
    this.#hint.hidden = !this.#app.hello || this.#app.hello.control || this.#app.hello.recording
    for (const module of this.#modules.values()) this.#ask(module)
    this.#findModules()
  }

  #findModules() {
    const { modules } = this.#app.store
    for (const { name, kind, link } of modules.values()) {
      if (kind === "firmware" || (!link && !this.#app.hello?.recording)) continue
      if (this.#modules.get(name)?.isFine()) continue
      const module = this.#modules.get(name) ?? new ModuleParameters(this.#app, name)
      this.#modules.set(name, module)
      this.#ask(module)
    }
    for (const name of this.#modules.keys()) if (!modules.has(name)) this.#modules.delete(name)
    this.#show()
  }

  // Ask a few modules at a time: on a slow link each answer takes its time.
  #ask(module) {
    if (!this.#queue.includes(module)) this.#queue.push(module)
    this.#next()
  }

  async #next() {
    if (this.#running >= AT_ONCE || !this.#queue.length) return
    this.#running++
    await this.#queue.shift().read()
    this.#running--
    this.#show()
    this.#next()
  }

  #show() {
    const sorted = [...this.#modules.values()].sort((one, other) => (one.name < other.name ? -1 : 1))
    const shown = sorted.filter(module => module.filter(this.#words))
    place(this.#list, shown.map(module => module.element))
    this.#empty.hidden = shown.length > 0
    setText(this.#empty, this.#words.length && sorted.length
      ? "Nothing matches the filter"
      : this.#running || this.#queue.length ? "Asking the modules" : "No module has parameters")
    this.element.dataset.parameters = sorted.reduce((sum, module) => sum + module.size, 0)
  }
}

class ModuleParameters {
  #app
  #nodes = []
  #error = h("p", { class: "dim", role: "status" })
  #save
  #body = h("div", { class: "stack" })
  #read = false
  #failed = false
  #askedAt = 0 // ms

  constructor(app, name) {
    this.#app = app
    this.name = name
    this.#save = button("Save", () => this.#saveAll(), { hidden: true, title: "Keep what was set, for the next start" })
    this.element = h("section", { class: "panel", dataset: { module: name }, "aria-label": `Parameters of ${name}` },
      h("div", { class: "head" }, h("h2", {}, name), this.#error, h("span", { class: "space" }), this.#save),
      this.#body)
    setText(this.#error, "asking")
  }

  get size() {
    return this.#nodes.reduce((sum, node) => sum + node.size, 0)
  }

  // Return whether there is no reason to ask it again: it has answered, or may still do so.
  isFine() {
    return !this.#failed || performance.now() < this.#askedAt + ASK_AGAIN
  }

  async read() {
    this.#askedAt = Infinity
    try {
      this.#take(await this.#app.connection.request("parameters", { module: this.name }))
      this.#failed = false
      setText(this.#error, "")
    } catch (error) {
      this.#failed = true
      setText(this.#error, error.message)
    }
    this.#askedAt = performance.now()
    this.#read = true
  }

  // Return whether the module has something to show for a filter.
  filter(words) {
    const named = words.every(word => this.name.toLowerCase().includes(word))
    const shown = this.#nodes.map(node => node.filter(words, this.name.toLowerCase()))
    if (!this.#read) return !words.length || named
    return shown.some(Boolean) || (this.#failed && named)
  }

  #take(list) {
    const before = new Map(this.#nodes.map(node => [node.name, node]))
    this.#nodes = byNode(list).map(([name, parameters]) => {
      const node = before.get(name) ?? new NodeParameters(this.#app, this, name)
      node.take(parameters)
      return node
    })
    place(this.#body, this.#nodes.map(node => node.element))
    this.#save.hidden = !this.#app.hello?.control || !list.length
  }

  async #saveAll() {
    this.#save.disabled = true
    const saved = await attempt(this.#app.connection.request("save_parameters", { module: this.name }))
    if (saved !== undefined) toast(`${this.name} has saved its parameters`)
    this.#save.disabled = false
    await this.read()
  }
}

// The parameters of a node: a form, as they are set together or not at all.
class NodeParameters {
  #app
  #module
  #rows = new Map()
  #body = h("div", { class: "parameter-rows" })
  #set = button("Set", null, { class: "primary", type: "submit" })
  #actions

  constructor(app, module, name) {
    this.#app = app
    this.#module = module
    this.name = name
    this.#actions = h("div", { class: "actions", hidden: true }, this.#set,
      button("Discard", () => this.#discard(), { class: "quiet" }))
    this.element = h("form", {
      class: "parameter-node", autocomplete: "off", novalidate: true, "aria-label": `${module.name}/${name}`,
      onsubmit: event => {
        event.preventDefault()
        this.#submit()
      },
    }, h("h3", {}, name), this.#body, this.#actions)
  }

  get size() {
    return this.#rows.size
  }

  take(list) {
    const before = this.#rows
    this.#rows = new Map(list.map(parameter => {
      const row = before.get(parameter.name) ?? new ParameterRow(parameter, {
        change: () => this.#changed(),
        reset: name => this.#send({ [name]: null }, `${this.name}.${name} has the value of its start again`),
      })
      row.take(parameter, { control: Boolean(this.#app.hello?.control) })
      return [parameter.name, row]
    }))
    place(this.#body, [...this.#rows.values()].map(row => row.element))
    this.#changed()
  }

  filter(words, module) {
    let shown = 0
    for (const row of this.#rows.values()) {
      const passes = words.every(word => `${module}/${this.name}.${row.name} ${row.doc}`.toLowerCase().includes(word))
      row.element.hidden = !passes
      shown += passes
    }
    this.element.hidden = !shown
    return shown > 0
  }

  #changed() {
    const changed = [...this.#rows.values()].filter(row => row.isChanged).length
    this.#actions.hidden = !changed
    setText(this.#set, `Set ${plural(changed, "parameter")}`)
  }

  #discard() {
    for (const row of this.#rows.values()) row.discard()
    this.#changed()
  }

  async #submit() {
    const changed = [...this.#rows.values()].filter(row => row.isChanged)
    const read = changed.map(row => [row.name, row.read()])
    const wrong = changed.find(row => row.isWrong)
    if (wrong) return wrong.focus()
    const done = `${plural(read.length, "parameter")} of ${this.#module.name}/${this.name} set`
    if (read.length) await this.#send(Object.fromEntries(read), done)
  }

  async #send(values, done) {
    this.#set.disabled = true
    try {
      const { name: module } = this.#module
      await this.#app.connection.request("set_parameters", { module, node: this.name, values })
      for (const name of Object.keys(values)) this.#rows.get(name)?.discard()
      toast(done)
    } catch (error) {
      this.#blame(error.message, Object.keys(values))
      return
    } finally {
      this.#set.disabled = false
    }
    await this.#module.read()
  }

  #blame(text, names) {
    const name = blamed(text, this.#module.name, this.name, names) ?? (names.length === 1 ? names[0] : null)
    if (!name) return toast(text, "bad")
    this.#rows.get(name).fail(text)
    this.#rows.get(name).focus()
  }
}

let ids = 0

class ParameterRow {
  #parameter
  #input
  #error
  #notes = h("span", { class: "parameter-notes" })
  #reset
  #changedValue = false

  constructor(parameter, { change, reset }) {
    this.name = parameter.name
    this.doc = parameter.doc ?? ""
    const id = `parameter-${++ids}`
    this.#input = controlFor(parameter)
    this.#input.id = id
    this.#error = h("p", { class: "error", id: `${id}-error`, hidden: true })
    this.#reset = button("Reset", () => reset(this.name), { class: "quiet" })
    for (const event of ["input", "change"]) {
      this.#input.addEventListener(event, () => {
        this.#changedValue = !isSame(this.#shownValue(), this.#written(this.#parameter.value))
        this.fail("")
        this.element.classList.toggle("changed", this.#changedValue)
        change()
      })
    }
    this.#input.addEventListener("blur", () => this.#changedValue && this.read())
    const hint = [limitsText(parameter), parameter.kind].filter(Boolean).join(" · ")
    this.#input.setAttribute("aria-describedby", `${id}-hint ${id}-error`)
    this.element = h("div", { class: "parameter", dataset: { parameter: parameter.name } },
      h("label", { for: id }, parameter.name),
      h("span", { class: "parameter-control" }, this.#input, h("span", { class: "unit" }, parameter.unit ?? "")),
      h("span", { class: "dim", id: `${id}-hint` }, hint), this.#notes, this.#reset,
      this.#error, this.doc ? h("p", { class: "dim doc" }, this.doc) : null)
  }

  get isChanged() {
    return this.#changedValue
  }

  get isWrong() {
    return !this.#error.hidden
  }

  // Show what the module says; what the user has changed and not set stays.
  take(parameter, { control }) {
    this.#parameter = parameter
    if (!this.#changedValue) this.#write(parameter.value)
    const why = parameter.default === undefined ? "This is a recording"
      : parameter.read_only ? "Read-only: it has its value from the start of the program"
      : control ? "" : "Start r2p dash with --allow-control to set it"
    this.#input.disabled = Boolean(why)
    this.#input.title = why
    const isDefault = isSame(parameter.value, parameter.default)
    this.#reset.hidden = Boolean(why) || parameter.origin !== "run time"
    const own = isDefault ? "" : `; the default is ${valueText(parameter.default)}`
    this.#reset.title = `Back to the value of the start${own}`
    this.#reset.setAttribute("aria-label", `Reset ${parameter.name}`)
    const notes = [...(parameter.read_only ? [{ text: "read-only", tone: "dim" }] : []), ...notesOf(parameter)]
    this.#notes.replaceChildren(...notes.map(({ text, tone }) => h("span", { dataset: { tone } }, text)))
  }

  discard() {
    this.#changedValue = false
    this.element.classList.remove("changed")
    this.fail("")
    this.#write(this.#parameter.value)
  }

  read() {
    try {
      return this.#parameter.kind === "bool" ? this.#input.checked : parseValue(this.#parameter, this.#input.value)
    } catch (error) {
      this.fail(error.message)
      return null
    }
  }

  fail(text) {
    setText(this.#error, text)
    this.#error.hidden = !text
    if (text) this.#input.setAttribute("aria-invalid", "true")
    else this.#input.removeAttribute("aria-invalid")
  }

  focus() {
    this.#input.focus()
  }

  #shownValue() {
    return this.#parameter.kind === "bool" ? this.#input.checked : this.#input.value
  }

  #written(value) {
    return this.#parameter.kind === "bool" ? value : valueText(value)
  }

  #write(value) {
    if (this.#parameter.kind === "bool") this.#input.checked = value
    else this.#input.value = valueText(value)
  }
}

function controlFor({ kind, choices }) {
  if (kind === "bool") return h("input", { type: "checkbox" })
  if (kind === "enum") return h("select", {}, choices.map(choice => h("option", { value: choice }, choice)))
  const isNumber = kind === "int" || kind === "float"
  return h("input", { class: isNumber ? "number" : null, autocomplete: "off", spellcheck: "false" })
}
