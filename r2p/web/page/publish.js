// Publishing by hand: a form made from the type of a topic, once or at a rate.

import { toast } from "./dialogs.js"
import { button, field, h, place, setText } from "./dom.js"
import { plural } from "./format.js"
import { MessageForm } from "./message_form.js"
import { Retries } from "./retries.js"

const RATE_MAX = 200 // messages per second; r2p/web/dash/publications.py refuses more
const RATE = 10

export const publish = {
  id: "publish",
  title: "Publish",
  keys: [["Enter", "publish once"]],
  available: hello => !hello.recording,
  create: app => new PublishView(app),
}

class PublishView {
  #app
  #form = null
  #topic = ""
  #typeName = ""
  #forms = new Map() // by topic: what was written there stays
  #running = new Map() // by topic: {rate, sent}
  #lines = new Map() // by topic, of the list of these
  #hint = h("p", { class: "hint", hidden: true },
    "Nothing can be published here: start r2p dash with --allow-publish to publish from this page.")
  #names = h("datalist", { id: "publish-topics" })
  #name = h("input", {
    type: "text", list: "publish-topics", autocomplete: "off", spellcheck: "false", placeholder: "Topic",
    "aria-keyshortcuts": "/", dataset: { filter: "" },
  })
  #types = h("datalist", { id: "publish-types" })
  #type = h("input", {
    type: "text", list: "publish-types", autocomplete: "off", spellcheck: "false", placeholder: "that of the topic",
  })
  #rate = h("input", { type: "text", inputmode: "decimal", class: "rate", value: String(RATE) })
  #about = h("p", { class: "dim", role: "status" })
  #error = h("p", { class: "error", role: "alert" })
  #box = h("div", { class: "form-box" })
  #once = button("Publish", null, { class: "primary", type: "submit" })
  #repeat = button("Repeat", () => this.#start(), { title: "Publish it again and again, at the rate" })
  #reset = button("Zeros", () => this.#form?.reset(), { class: "quiet", title: "Set all fields to zero" })
  #actions = h("div", { class: "actions", hidden: true },
    this.#once, this.#repeat, field("at", this.#rate), "Hz", this.#reset)
  #list = h("ul", { class: "running", "aria-label": "Published at a rate" })
  #chip = h("a", { class: "chip warn", href: "#/publish", hidden: true })
  #retries = new Retries()
  #update = () => {
    this.#describeTopic()
    if (this.#retries.due) this.#makeForm()
  }

  constructor(app) {
    this.#app = app
    this.element = h("section", { class: "view publish-view" },
      h("div", { class: "bar" }, h("h2", {}, "Publish"), field("Topic", this.#name, { hidden: true }), this.#names,
        field("Type", this.#type), this.#types,
        button("Open", () => this.#choose(this.#name.value, this.#type.value))),
      this.#hint, this.#about, this.#list,
      h("form", { novalidate: true, autocomplete: "off", onsubmit: event => {
        event.preventDefault()
        this.#publish(0)
      } }, this.#box, this.#error, this.#actions))
    for (const input of [this.#name, this.#type]) input.addEventListener("change", () => this.#changed())
    this.#name.addEventListener("keydown", event => event.key === "Enter" && this.#changed())
    document.querySelector(".top .tools")?.prepend(this.#chip)
    app.connection.addEventListener("published", event => this.#published(event.detail))
    app.connection.addEventListener("hello", () => this.#begin())
  }

  show(argument) {
    this.#app.store.addEventListener("change", this.#update)
    this.#allow()
    if (!this.#types.children.length) this.#findTypes().catch(() => {}) // a convenience: types can be written, too
    if (argument && argument !== this.#topic) this.#choose(argument, "")
    this.#describeTopic()
  }

  hide() {
    this.#app.store.removeEventListener("change", this.#update)
  }

  async #findTypes() {
    const { types } = await this.#app.connection.request("describe")
    this.#types.replaceChildren(...types.map(name => h("option", { value: name })))
  }

  #begin() {
    this.#running.clear() // the process that a page has left publishes nothing for it
    this.#drawRunning()
    this.#allow()
  }

  #allow() {
    const allowed = Boolean(this.#app.hello?.publish)
    this.#hint.hidden = !this.#app.hello || allowed
    for (const each of [this.#once, this.#repeat, this.#rate]) {
      each.disabled = !allowed
      each.title = allowed ? "" : "Start r2p dash with --allow-publish"
    }
  }

  #changed() {
    const name = this.#name.value.trim()
    const type = this.#type.value.trim()
    if (name && (name !== this.#topic || type !== this.#typeName)) this.#choose(name, type)
  }

  async #choose(name, type) {
    this.#topic = this.#name.value = name.trim()
    this.#type.value = this.#typeName = type.trim()
    this.#app.rename("publish", this.#topic)
    setText(this.#error, "")
    this.#show(null)
    this.#retries.reset()
    if (!this.#topic) return
    setText(this.#about, "Asking for the type")
    await this.#makeForm()
    this.#describeTopic()
  }

  // A type that could not be found, as the modules that have it were silent, is asked for again.
  async #makeForm() {
    const [topic, type] = [this.#topic, this.#typeName]
    const isCurrent = () => topic === this.#topic && type === this.#typeName
    this.#retries.begin()
    try {
      const form = await this.#formOf(topic, type)
      if (!isCurrent()) return
      setText(this.#error, "")
      this.#show(form)
    } catch (error) {
      if (!isCurrent()) return
      setText(this.#error, error.message)
      if (this.#app.store.topics.has(topic)) this.#retries.fail()
    }
  }

  async #formOf(topic, type) {
    const key = `${topic} ${type}`
    if (!this.#forms.has(key)) {
      const description = await this.#app.connection.request("describe", { topic, type })
      this.#forms.set(key, { form: new MessageForm(description), type: description.type })
    }
    return this.#forms.get(key)
  }

  #show(made) {
    this.#form = made?.form ?? null
    this.#actions.hidden = !made
    this.#box.replaceChildren(...(made ? [h("h3", {}, made.type), made.form.element] : []))
  }

  #describeTopic() {
    const topics = [...this.#app.store.topics.values()].filter(topic => !topic.is_of_service)
    const names = topics.map(topic => topic.name).sort()
    if (names.join() !== this.#names.dataset.names) {
      this.#names.dataset.names = names.join()
      this.#names.replaceChildren(...names.map(name => h("option", { value: name })))
    }
    const topic = this.#app.store.topics.get(this.#topic)
    if (!this.#topic) return setText(this.#about, "Choose a topic: its type makes the form.")
    if (!topic) return setText(this.#about, `${this.#topic} is not on the network yet: choose the type that it is to have.`)
    const others = topic.publishers?.filter(each => each.module).map(each => each.module) ?? []
    const by = others.length ? ` · also published by ${[...new Set(others)].join(", ")}` : ""
    const known = topic.subscribers?.length ? plural(topic.subscribers.length, "subscriber") : "no subscriber is known"
    setText(this.#about, known + by)
  }

  // Publishing

  async #publish(rate) {
    setText(this.#error, "")
    const value = this.#form?.read()
    if (!value) return
    const topic = this.#topic
    const type = this.#type.value.trim()
    try {
      const request = { topic, value, type, rate }
      const { subscribed } = await this.#app.connection.request("publish", request) ?? {}
      this.#done(topic, rate, subscribed)
    } catch (error) {
      if (!this.#form.blame(error.message)) setText(this.#error, error.message)
    }
  }

  // Publishing once ends the repetition of a topic, too.
  #done(topic, rate, subscribed) {
    if (rate) this.#running.set(topic, { rate, sent: 0 })
    else this.#running.delete(topic)
    this.#drawRunning()
    const heard = subscribed === false ? ", but nothing subscribes to it" : ""
    if (!rate || heard) toast(`${topic}: ${rate ? "publishing" : "published"}${heard}`, heard ? "bad" : "good")
  }

  #start() {
    const rate = Number(this.#rate.value.replace(",", "."))
    if (rate > 0 && rate <= RATE_MAX) return this.#publish(rate)
    this.#rate.setAttribute("aria-invalid", "true")
    setText(this.#error, `The rate is more than 0, and at most ${RATE_MAX} Hz`)
    this.#rate.addEventListener("input", () => this.#rate.removeAttribute("aria-invalid"), { once: true })
    return this.#rate.focus()
  }

  async #stop(topic) {
    try {
      await this.#app.connection.request("stop_publishing", { topic })
      this.#running.delete(topic)
    } catch (error) {
      toast(error.message, "bad")
    }
    this.#drawRunning()
  }

  #published({ topic, sent, running, error }) {
    if (error) toast(`${topic} is published no more: ${error}`, "bad")
    const known = this.#running.get(topic)
    if (running && known) known.sent = sent
    else if (!running) this.#running.delete(topic)
    this.#drawRunning()
  }

  #drawRunning() {
    const topics = [...this.#running.keys()]
    this.#lines = new Map(topics.map(topic => [topic, this.#lines.get(topic) ?? this.#line(topic)]))
    for (const [topic, { rate, sent }] of this.#running) this.#lines.get(topic).update(rate, sent)
    place(this.#list, [...this.#lines.values()].map(line => line.element))
    this.#chip.hidden = !this.#running.size
    setText(this.#chip, `publishing ${plural(this.#running.size, "topic")}`)
  }

  #line(topic) {
    const [what, count] = [h("span", { class: "chip warn" }), h("span", { class: "dim" })]
    const stop = button("Stop", () => this.#stop(topic), { class: "danger", "aria-label": `Stop ${topic}` })
    const update = (rate, sent) => {
      setText(what, `${topic} at ${rate} Hz`)
      setText(count, `${sent} sent`)
    }
    return { element: h("li", { dataset: { topic } }, what, count, stop), update }
  }
}
