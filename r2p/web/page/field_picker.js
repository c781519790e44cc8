// Chooses the fields of a plot: all topics, searched by words, and what of their messages can be plotted.

import { openDialog } from "./dialogs.js"
import { button, h, oncePerFrame, setText } from "./dom.js"
import { plural } from "./format.js"

const DESCRIBED_AT_ONCE = 40 // topics whose types are asked for without a click
const SHOWN = 120 // topics
const OPEN = 4 // topics of a small network, whose fields are listed at once
const ELEMENTS = 16 // of an array that are listed; others are typed: scan.ranges[57]

// What can be plotted of each topic, asked once.
export class FieldCatalog {
  #connection
  #known = new Map()
  #asked = new Map()

  constructor(connection) {
    this.#connection = connection
    connection.addEventListener("hello", () => {
      this.#known.clear()
      this.#asked.clear()
    })
  }

  known(topic) {
    return this.#known.get(topic)
  }

  // Return {fields: [names]} or {error}, when it is known.
  describe(topic) {
    if (!this.#asked.has(topic)) this.#asked.set(topic, this.#ask(topic))
    return this.#asked.get(topic)
  }

  // What failed may be known by now.
  forgetErrors() {
    for (const [topic, { error }] of this.#known) {
      if (error === undefined) continue
      this.#known.delete(topic)
      this.#asked.delete(topic)
    }
  }

  async #ask(topic) {
    let known
    try {
      const { fields } = await this.#connection.request("describe", { topic })
      known = { fields: fields.filter(each => each.plottable).flatMap(each => names(topic, each)) }
    } catch (error) {
      known = { error: error.message }
    }
    this.#known.set(topic, known)
    return known
  }
}

function names(topic, { path, length, max }) {
  const first = `${topic}.${path.replaceAll("[]", "[0]")}`
  const size = length ?? max
  if (size === undefined) return [first]
  return Array.from({ length: Math.min(size, ELEMENTS) }, (_, index) => `${first}[${index}]`)
}

// Open the dialog. `chosen()` returns the fields that are plotted, `toggle(name, wanted)` is called for each choice.
export function pickFields({ app, catalog, chosen, toggle, onclose }) {
  new FieldPicker(app, catalog, chosen, toggle).open(onclose)
}

class FieldPicker {
  #app
  #catalog
  #chosen
  #toggle
  #words = []
  #text = ""
  #open = new Set()
  #list = h("div", { class: "picker-list" })
  #found = h("p", { class: "dim", role: "status" })
  #drawSoon = oncePerFrame(() => this.#draw())

  constructor(app, catalog, chosen, toggle) {
    this.#app = app
    this.#catalog = catalog
    this.#chosen = chosen
    this.#toggle = toggle
  }

  open(onclose) {
    const search = h("input", { type: "search", placeholder: "Words of a topic and a field", autofocus: true,
      "aria-label": "Search topics and fields", autocomplete: "off", spellcheck: "false",
      oninput: () => this.#search(search.value), onkeydown: event => event.key === "Enter" && this.#chooseTyped() })
    this.#catalog.forgetErrors()
    const dialog = openDialog({
      title: "Fields to plot", body: [search, this.#found, this.#list],
      actions: [button("Done", () => dialog.close(), { class: "primary" })], onclose,
    })
    dialog.classList.add("picker")
    this.#search("")
  }

  #search(text) {
    this.#text = text.trim()
    this.#words = this.#text.toLowerCase().split(/\s+/).filter(Boolean)
    this.#draw()
    this.#describeFirst()
  }

  #topics() {
    const topics = [...this.#app.store.topics.values()].filter(topic => !topic.is_of_service).map(topic => topic.name)
    return topics.sort().filter(topic => this.#matches(topic))
  }

  #matches(topic) {
    if (!this.#words.length) return true
    const fields = this.#catalog.known(topic)?.fields
    if (fields) return this.#fieldsOf(topic).length > 0
    return this.#words.some(word => topic.toLowerCase().includes(word.split(".", 1)[0]))
  }

  #fieldsOf(topic) {
    const fields = this.#catalog.known(topic)?.fields ?? []
    return fields.filter(field => this.#words.every(word => field.toLowerCase().includes(word)))
  }

  // In a small network all fields are searched; in a large one those of the topics that match.
  #describeFirst() {
    const all = [...this.#app.store.topics.keys()]
    const topics = (all.length <= DESCRIBED_AT_ONCE ? all : this.#words.length ? this.#topics() : [])
      .filter(topic => !this.#catalog.known(topic)).slice(0, DESCRIBED_AT_ONCE)
    for (const topic of topics) this.#catalog.describe(topic).then(this.#drawSoon)
  }

  #draw() {
    const topics = this.#topics()
    const typed = this.#typed()
    this.#list.replaceChildren(
      ...(typed ? [this.#choice(typed)] : []), ...topics.slice(0, SHOWN).map(topic => this.#topic(topic)))
    setText(this.#found, topics.length > SHOWN
      ? `${plural(topics.length, "topic")}, of which ${SHOWN} are listed: type to find one`
      : plural(topics.length, "topic"))
  }

  // A field that is typed in full, as scan.ranges[57], though it is not in the list.
  #typed() {
    const topic = this.#text.split(".", 1)[0]
    const listed = this.#catalog.known(topic)?.fields?.includes(this.#text)
    return this.#app.store.topics.has(topic) && /^[^\s.]+\.\S+$/.test(this.#text) && !listed ? this.#text : ""
  }

  #chooseTyped() {
    const only = this.#list.querySelectorAll("input[type=checkbox]")
    if (only[0] && (this.#typed() || only.length === 1)) only[0].click()
  }

  #topic(topic) {
    const details = h("details", {}, h("summary", {}, topic), h("div", { class: "picker-fields" }))
    details.open = this.#open.has(topic) || this.#words.length > 0 || this.#app.store.topics.size <= OPEN
    if (details.open) this.#fill(details, topic)
    details.addEventListener("toggle", () => {
      if (!this.#words.length && details.open) this.#open.add(topic)
      else this.#open.delete(topic)
      if (details.open) this.#fill(details, topic)
    })
    return details
  }

  async #fill(details, topic) {
    const box = details.lastElementChild
    if (!this.#catalog.known(topic)) box.replaceChildren(h("p", { class: "dim" }, "asking for its type"))
    const { error, fields = [] } = await this.#catalog.describe(topic)
    const shown = this.#words.length ? this.#fieldsOf(topic) : fields
    box.replaceChildren(...(error ? [h("p", { class: "dim" }, error)] : shown.map(field => this.#choice(field))))
    if (!error && !shown.length) box.append(h("p", { class: "dim" }, "nothing in it is a number"))
  }

  #choice(name) {
    const box = h("input", { type: "checkbox", checked: this.#chosen().includes(name),
      onchange: () => this.#toggle(name, box.checked) })
    return h("label", { class: "choice" }, box, h("span", {}, name))
  }
}
