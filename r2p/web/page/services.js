// The services of the network, and calls to them: a form for the request, the response, and how long it took.

import { button, field, filterBox, h, setText } from "./dom.js"
import { count, UNKNOWN } from "./format.js"
import { MessageForm } from "./message_form.js"
import { Retries } from "./retries.js"
import { LiveTable } from "./table.js"

const TIMEOUT = 5 // s
const TIMEOUT_MAX = 300 // s; r2p/web/dash/publications.py refuses more
const CALLS = 20 // calls that are listed

export const services = {
  id: "services",
  title: "Services",
  keys: [["Enter", "call"]],
  available: hello => !hello.recording,
  create: app => new ServicesView(app),
}

const figure = (id, title, hint, level) => ({
  id, title, hint, level, number: true, value: service => service[id], text: service => count(service[id]),
})

const COLUMNS = app => [
  { id: "name", title: "Service", value: service => service.name,
    link: service => app.address("services", service.name) },
  { id: "type", title: "Type", level: 3, value: service => service.type, tone: () => "dim" },
  { id: "servers", title: "Servers", value: service => service.servers?.join(", ") || null, level: 2,
    tone: service => service.servers?.length ? "" : "warn", text: service => service.servers?.join(", ") || "none" },
  figure("handled", "Answered", "Requests that were answered", 2),
  figure("failed", "Failed", "Requests whose handler raised", 2),
  figure("refused", "Refused", "Requests that were refused, as too many waited", 3),
  figure("running", "Running", "Requests that are being handled", 3),
  figure("waiting", "Waiting", "Requests that wait for others", 3),
]

class ServicesView {
  #app
  #table
  #service = ""
  #form = null
  #calling = 0
  #title = h("h2", { class: "wrap" })
  #hint = h("p", { class: "hint", hidden: true },
    "Services can't be called here: start r2p dash with --allow-publish to call them from this page.")
  #error = h("p", { class: "error", role: "alert" })
  #box = h("div", { class: "form-box" })
  #call = button("Call", null, { class: "primary", type: "submit" })
  #timeout = h("input", { type: "text", inputmode: "decimal", class: "rate", value: String(TIMEOUT) })
  #actions = h("div", { class: "actions", hidden: true }, this.#call, field("within", this.#timeout), "s")
  #calls = h("ol", { class: "calls stack", "aria-label": "Calls, the newest first" })
  #said = h("p", { class: "sr-only", role: "status" })
  #panel
  #retries = new Retries()
  #update = () => {
    this.#table.update(this.#app.store.services.values())
    if (this.#retries.due) this.#describe()
  }

  constructor(app) {
    this.#app = app
    this.#table = new LiveTable({
      id: "services", caption: "Services", columns: COLUMNS(app), key: service => service.name, sort: "name",
      search: service => [service.name, service.type, ...(service.servers ?? [])].join(" "),
      empty: "No services are known",
    })
    const form = h("form", { novalidate: true, autocomplete: "off", onsubmit: event => {
      event.preventDefault()
      this.#send()
    } }, this.#box, this.#error, this.#actions)
    const close = button("×", () => this.#choose(""), { class: "quiet close", "aria-label": "Close the service" })
    this.#panel = h("section", { class: "panel call", hidden: true },
      h("div", { class: "head" }, this.#title, h("span", { class: "space" }), close), this.#hint,
      h("div", { class: "columns" }, form, h("div", {}, h("h3", {}, "Responses"), this.#said, this.#calls)))
    this.element = h("section", { class: "view services-view" },
      h("div", { class: "bar" }, h("h2", {}, "Services"),
        filterBox("Filter services", text => this.#table.filter(text))), this.#panel, this.#table.element)
    app.connection.addEventListener("hello", () => this.#allow())
  }

  show(argument) {
    this.#app.store.addEventListener("change", this.#update)
    this.#update()
    this.#allow()
    if (argument !== this.#service) this.#choose(argument)
  }

  hide() {
    this.#app.store.removeEventListener("change", this.#update)
  }

  #allow() {
    const allowed = Boolean(this.#app.hello?.publish)
    this.#hint.hidden = !this.#app.hello || allowed
    this.#call.disabled = !allowed
    this.#call.title = allowed ? "" : "Start r2p dash with --allow-publish"
  }

  async #choose(service) {
    this.#service = service
    this.#app.rename("services", service)
    this.#form = null
    this.#panel.hidden = !service
    this.#actions.hidden = true
    this.#box.replaceChildren()
    this.#calls.replaceChildren()
    setText(this.#title, service)
    setText(this.#error, "")
    this.#retries.reset()
    if (service) await this.#describe()
  }

  // A service that could not be described, as its server was silent, is asked for again.
  async #describe() {
    const service = this.#service
    this.#retries.begin()
    try {
      const { request } = await this.#app.connection.request("describe", { service })
      if (service !== this.#service) return
      setText(this.#error, "")
      this.#show(request)
    } catch (error) {
      if (service !== this.#service) return
      setText(this.#error, error.message)
      this.#retries.fail()
    }
  }

  #show(request) {
    this.#form = new MessageForm(request)
    this.#box.replaceChildren(h("h3", {}, "Request"), this.#form.element)
    this.#actions.hidden = false
  }

  async #send() {
    const timeout = Number(this.#timeout.value.replace(",", "."))
    setText(this.#error, "")
    if (!(timeout > 0 && timeout <= TIMEOUT_MAX)) {
      setText(this.#error, `The time for an answer is more than 0, and at most ${TIMEOUT_MAX} s`)
      return this.#timeout.focus()
    }
    const value = this.#form?.read()
    if (value) await this.#ask(value, timeout)
  }

  async #ask(value, timeout) {
    const line = h("li", {}, h("p", { class: "dim" }, "waiting for the response"))
    const form = this.#form
    this.#calls.prepend(line)
    while (this.#calls.children.length > CALLS) this.#calls.lastChild.remove()
    this.#count(1)
    const begin = performance.now()
    const took = () => `${(performance.now() - begin).toFixed(1)} ms`
    try {
      const result = await this.#app.connection.request("call", { service: this.#service, value, timeout })
      this.#answer(line, `answered in ${took()}`, h("pre", { class: "result" }, resultText(result)))
    } catch (error) {
      this.#answer(line, `failed after ${took()}`, h("p", { class: "error" }, error.message))
      if (form === this.#form) form.blame(error.message)
    }
    this.#count(-1)
  }

  #count(change) {
    this.#calling += change
    setText(this.#call, this.#calling ? `Call (${this.#calling} waiting)` : "Call")
  }

  #answer(line, about, shown) {
    line.replaceChildren(h("p", { class: "dim" }, about), shown)
    setText(this.#said, about)
  }
}

function resultText(result) {
  if (result === null || result === undefined) return UNKNOWN
  return Object.keys(result).length ? JSON.stringify(result, null, 2) : "a response without fields"
}
