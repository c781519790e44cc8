// Modules and their nodes: what runs, and orders to start, stop, restart and reboot.

import { attempt, confirmed } from "./dialogs.js"
import { button, filterBox, h, place, setText } from "./dom.js"
import { count, duration, percent, plural, UNKNOWN } from "./format.js"

const STATES = { running: "good", stopped: "warn", boot: "warn", observer: "" }

// Orders to a module: the text of the button, the question before it, and the message when it is done.
const MODULE_ORDERS = {
  start: {
    text: "Start", danger: false,
    ask: name => `Start all nodes of ${name}?`, done: name => `${name} is started`,
  },
  stop: {
    text: "Stop", danger: true,
    ask: name => `Stop all nodes of ${name}? What they drive is then not controlled.`,
    done: name => `${name} is stopped`,
  },
  reboot: {
    text: "Reboot", danger: true,
    ask: name => `Reboot ${name}? All of its nodes end and start again.`, done: name => `${name} has rebooted`,
  },
}
const NODE_ORDERS = {
  start: { text: "Start", danger: false, ask: name => `Start ${name}?`, done: name => `${name} is started` },
  stop: {
    text: "Stop", danger: true,
    ask: name => `Stop ${name}? What it drives is then not controlled.`, done: name => `${name} is stopped`,
  },
  restart: {
    text: "Restart", danger: true, ask: name => `Restart ${name}?`, done: name => `${name} is started again`,
  },
}

export const nodes = {
  id: "nodes",
  title: "Nodes",
  create: app => new NodesView(app),
}

class NodesView {
  #app
  #panels = new Map()
  #words = []
  #list = h("div", { class: "stack" })
  #empty = h("p", { class: "empty" })
  #counts = h("p", { class: "dim", role: "status" })
  #hint = h("p", { class: "hint", hidden: true },
    "Nothing can be started or stopped here: start r2p dash with --allow-control for that.")
  #filter = filterBox("Filter modules and nodes", text => {
    this.#words = text.toLowerCase().split(/\s+/).filter(Boolean)
    this.#update()
  })
  #update = () => this.#draw()

  constructor(app) {
    this.#app = app
    this.element = h("section", { class: "view nodes-view" },
      h("div", { class: "bar" }, h("h2", {}, "Nodes"), this.#filter, this.#counts), this.#hint, this.#empty, this.#list)
  }

  show(argument) {
    this.#app.store.addEventListener("change", this.#update)
    if (argument) {
      this.#filter.value = argument
      this.#words = argument.toLowerCase().split(/\s+/).filter(Boolean)
    }
    this.#draw()
  }

  hide() {
    this.#app.store.removeEventListener("change", this.#update)
  }

  #draw() {
    const { hello, store } = this.#app
    this.#hint.hidden = !hello || hello.control || hello.recording
    const modules = [...store.modules.values()].sort((one, other) => (one.name < other.name ? -1 : 1))
    for (const name of this.#panels.keys()) if (!store.modules.has(name)) this.#panels.delete(name)
    const shown = modules.filter(module => this.#matches(module))
    for (const module of shown) this.#panel(module).update(module, { control: Boolean(hello?.control) })
    place(this.#list, shown.map(module => this.#panel(module).element))
    this.#empty.hidden = shown.length > 0
    setText(this.#empty, modules.length ? "Nothing matches the filter" : "No modules yet")
    const all = modules.reduce((sum, module) => sum + (module.nodes?.length ?? 0), 0)
    setText(this.#counts, `${plural(modules.length, "module")}, ${plural(all, "node")}`)
    Object.assign(this.element.dataset, { modules: modules.length, nodes: all })
  }

  #matches({ name, state, kind, nodes: list = [] }) {
    const text = [name, state, kind, ...list.map(node => `${name}/${node.name}`)].join(" ").toLowerCase()
    return this.#words.every(word => text.includes(word))
  }

  #panel({ name }) {
    if (!this.#panels.has(name)) this.#panels.set(name, new ModulePanel(this.#app, name))
    return this.#panels.get(name)
  }
}

class ModulePanel {
  #app
  #module = null
  #control = null
  #state = h("span", { class: "chip" })
  #facts = h("p", { class: "dim" })
  #orders = h("div", { class: "actions" })
  #body = h("tbody")
  #rows = new Map()
  #table
  #none = h("p", { class: "dim" })

  constructor(app, name) {
    this.#app = app
    const heads = [
      ["Node"], ["State"], ["Restarts", "number level-2"], ["Publishes", "level-2"], ["Subscribes to", "level-2"],
      ["Orders"],
    ]
    this.#table = h("div", { class: "table-box" }, h("table", { class: "plain nodes-table" },
      h("caption", { class: "sr-only" }, `Nodes of ${name}`),
      h("thead", {}, h("tr", {}, heads.map(([head, kind]) => h("th", { scope: "col", class: kind }, head)))),
      this.#body))
    this.element = h("section", { class: "panel module", dataset: { module: name }, "aria-label": `Module ${name}` },
      h("div", { class: "head" },
        h("h2", {}, name), this.#state, this.#facts, h("span", { class: "space" }), this.#orders),
      this.#table, this.#none)
  }

  update(module, { control }) {
    if (module === this.#module && control === this.#control) return
    const before = this.#module
    const changedOrders = control !== this.#control || module.kind !== before?.kind || module.state !== before.state
    this.#module = module
    this.#control = control
    setText(this.#state, module.state)
    this.#state.className = `chip ${STATES[module.state] ?? ""}`
    setText(this.#facts, factsOf(module))
    if (changedOrders) this.#drawOrders(module)
    this.#drawNodes(module.nodes ?? [])
    const why = module.answers === false ? "It does not answer: its figures are those of before, or not known." : ""
    setText(this.#none, why || (module.nodes?.length ? "" : "Its nodes are not known."))
  }

  #drawOrders({ name, kind, link, state }) {
    const possible = link && kind !== "ROS" && !this.#app.hello?.recording
    const orders = state === "running" ? ["stop", "reboot"] : ["start", "reboot"]
    this.#orders.replaceChildren(...(possible ? orders : []).map(order => (
      this.#button(MODULE_ORDERS[order], name, () => this.#app.connection.request("module", { module: name, order })))))
  }

  #drawNodes(list) {
    this.#table.hidden = !list.length
    const rows = new Map(list.map(node => [node.name, this.#rows.get(node.name) ?? this.#row(node)]))
    for (const node of list) rows.get(node.name).update(node)
    place(this.#body, [...rows.values()].map(row => row.element))
    this.#rows = rows
  }

  #row({ name }) {
    const full = `${this.#module.name}/${name}`
    const [state, restarts, publishes, subscribes] = ["", "number level-2", "level-2 names", "level-2 names"]
      .map(kind => h("td", { class: kind }))
    const orders = h("td", { class: "orders" })
    if (this.#module.link && this.#module.kind === "r2p" && !this.#app.hello?.recording) {
      const send = order => this.#app.connection.request("node", { module: this.#module.name, node: name, order })
      orders.append(h("div", { class: "actions" }, Object.keys(NODE_ORDERS).map(order => (
        this.#button(NODE_ORDERS[order], full, () => send(order), "quiet")))))
    }
    const element = h("tr", { dataset: { node: name } },
      h("th", { scope: "row" }, name), state, restarts, publishes, subscribes, orders)
    return { element, update: node => {
      setText(state, stateText(node))
      state.dataset.tone = node.running === false ? "warn" : ""
      setText(restarts, count(node.restarts))
      restarts.dataset.tone = node.restarts ? "warn" : ""
      setText(publishes, node.publishes?.join(", ") ?? "")
      setText(subscribes, node.subscribes?.join(", ") ?? "")
      const possible = ordersOf(node, this.#module)
      for (const each of orders.querySelectorAll("button")) {
        each.hidden = !possible.includes(each.dataset.order)
        each.disabled = !this.#control
        each.title = this.#control ? "" : "Start r2p dash with --allow-control"
      }
    } }
  }

  #button({ text, danger, ask, done }, name, send, kind = "") {
    const element = button(text, async () => {
      if (!await confirmed(`${text} ${name}`, ask(name), text, { danger })) return
      element.disabled = true
      await attempt(send(), done(name))
      element.disabled = !this.#control
    }, {
      class: kind, "aria-label": `${text} ${name}`, disabled: !this.#control, dataset: { order: text.toLowerCase() },
      title: this.#control ? null : "Start r2p dash with --allow-control",
    })
    return element
  }
}

// A node of which its module says nothing, while it answers, is a part of r2p and takes no orders: that of its log.
function ordersOf({ running }, { answers }) {
  if (running === true) return ["stop", "restart"]
  if (running === false) return ["start"]
  return answers === true ? [] : Object.keys(NODE_ORDERS)
}

function stateText({ running }) {
  if (running === undefined || running === null) return UNKNOWN
  return running ? "running" : "stopped"
}

function factsOf({ kind, release, uptime, cpu, age, rebooted }) {
  return [
    kind, release ? `r2p ${release}` : "", uptime === undefined ? "" : `up ${duration(uptime)}`,
    cpu === undefined ? "" : `CPU ${percent(cpu)} %`, age > 5 ? `last heard ${duration(age)} ago` : "",
    rebooted ? "has rebooted" : "",
  ].filter(Boolean).join(" · ")
}
