// The frame around the views: navigation, the state of the connection, the theme, keys and help.

import { openDialog, toast } from "./dialogs.js"
import { button, h, setText } from "./dom.js"
import { plural } from "./format.js"

const KEYS = [
  ["1 … 9, 0", "the views, in their order"],
  ["/", "filter"],
  ["p or space", "pause and resume"],
  ["↑ ↓", "the rows of a table, once one of them has the keyboard"],
  ["t", "theme: as the system, light, dark"],
  ["Esc", "close what is open"],
  ["?", "this help"],
]
const THEMES = { auto: "Auto", light: "Light", dark: "Dark" }

const by = id => document.getElementById(id)

export class Shell {
  #app
  #views
  #view = null
  #part = null
  #dropped = {}

  constructor(app, views) {
    this.#app = app
    this.#views = views
  }

  start() {
    this.#navigate()
    this.#nameTheme()
    by("theme").onclick = () => this.#changeTheme()
    by("help").onclick = () => this.#help()
    by("dropped").onclick = () => this.#explainDropped()
    by("skip").onclick = event => {
      event.preventDefault()
      by("view").focus()
    }
    document.addEventListener("keydown", event => this.#press(event))
    this.#follow(this.#app.connection)
  }

  // A view is shown now; `part` is what its create() has returned.
  shows(view, part) {
    this.#view = view
    this.#part = part
    for (const link of by("views").children) {
      if (link.dataset.view === view.id) link.setAttribute("aria-current", "page")
      else link.removeAttribute("aria-current")
    }
    const current = by("views").querySelector("[aria-current]")
    if (current) reveal(by("views"), current)
    this.#entitle()
  }

  #entitle() {
    const network = this.#app.hello?.title || "r2p"
    setText(by("title"), network)
    by("title").title = network
    document.title = `${this.#view?.title ?? ""} · ${network}`
  }

  #available() {
    return this.#views.filter(view => !this.#app.hello || (view.available?.(this.#app.hello) ?? true))
  }

  #navigate() {
    by("views").replaceChildren(...this.#available().map((view, index) => h(
      "a",
      {
        href: `#/${view.id}`,
        dataset: { view: view.id },
        "aria-keyshortcuts": index < 10 ? (index + 1) % 10 : null,
        "aria-current": view === this.#view ? "page" : null,
      },
      h("span", {}, view.title),
      index < 10 ? h("kbd", { "aria-hidden": "true" }, (index + 1) % 10) : null,
    )))
  }

  #follow(connection) {
    connection.addEventListener("hello", event => this.#connected(event.detail))
    connection.addEventListener("lost", event => this.#lost(event.detail))
    connection.addEventListener("dropped", event => this.#drop(event.detail.streams))
  }

  #connected(hello) {
    this.#state("on", hello.recording ? "recording" : "live")
    by("banner").hidden = true
    by("dropped").hidden = true
    this.#dropped = {}
    this.#navigate()
    this.#entitle()
  }

  #lost({ reason, wait, ever }) {
    this.#state("off", "not connected")
    const why = reason || (ever
      ? "The connection to r2p dash is lost, and figures are those of before."
      : "Can't connect to r2p dash: has it ended, or does the link lack its token?")
    const again = button("Try now", () => this.#app.connection.open())
    by("banner").replaceChildren(h("p", {}, `${why} Trying again in ${Math.round(wait / 1000)} s.`), again)
    by("banner").hidden = false
  }

  #state(state, text) {
    by("state").dataset.state = state
    setText(by("state"), text)
  }

  // The process has dropped messages for this page: it says so, since plots and logs then have gaps.
  #drop(streams) {
    const first = by("dropped").hidden
    this.#dropped = streams
    const sum = Object.values(streams).reduce((all, each) => all + each, 0)
    by("dropped").hidden = sum === 0
    setText(by("dropped"), `${sum} dropped`)
    by("dropped").title = "Messages that this page was too slow for"
    if (first && sum) toast("This page was too slow: messages were dropped", "bad")
  }

  #explainDropped() {
    const rows = Object.entries(this.#dropped).map(([stream, size]) => h("li", {}, `${stream}: ${size}`))
    openDialog({
      title: "Dropped for this page",
      body: [
        h("p", {}, "The browser, or the way to it, was too slow for what this page asked for. The process dropped the "
          + "oldest messages, so plots and the log have gaps. Plot fewer fields, or look from a nearer computer."),
        h("ul", {}, rows),
      ],
    })
  }

  #changeTheme() {
    window.r2pTheme.next()
    this.#nameTheme()
  }

  #nameTheme() {
    const name = THEMES[window.r2pTheme.choice]
    setText(by("theme"), name)
    by("theme").setAttribute("aria-label", `Theme: ${name}`)
    by("theme").title = "Theme: as the system, light, dark (t)"
  }

  #press(event) {
    if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return
    if (event.key !== "Escape" && isTyping(event.target)) return
    if (this.#part?.key?.(event) || this.#act(event)) event.preventDefault()
  }

  #act(event) {
    const onControl = event.target.closest?.("button, a, summary, [role=slider]")
    if (event.key === " " && onControl) return false
    if (/^\d$/.test(event.key)) return this.#jump((Number(event.key) + 9) % 10)
    const acts = {
      "/": () => this.#control("[data-filter]")?.focus(),
      p: () => this.#control("[data-pause]")?.click(),
      " ": () => this.#control("[data-pause]")?.click(),
      t: () => this.#changeTheme(),
      "?": () => this.#help(),
    }
    acts[event.key]?.()
    return event.key in acts
  }

  #control(selector) {
    return by("timeline").querySelector(selector) ?? by("view").querySelector(selector)
  }

  #jump(index) {
    const view = this.#available()[index]
    if (view) this.#app.open(view.id)
    return view !== undefined
  }

  #help() {
    const { hello, store } = this.#app
    const allowed = hello?.recording ? [] : [
      `Publishing and calls: ${hello?.publish ? "allowed" : "not allowed (r2p dash --allow-publish)"}`,
      `Parameters and orders: ${hello?.control ? "allowed" : "not allowed (r2p dash --allow-control)"}`,
    ]
    openDialog({
      title: "Keys",
      body: [
        keysTable("Keys", KEYS),
        this.#view?.keys ? [h("h3", {}, this.#view.title), keysTable(`Keys of ${this.#view.title}`, this.#view.keys)] : [],
        h("p", { class: "dim" }, [
          `r2p ${hello?.version ?? ""}`, plural(store.topics.size, "topic"), ...allowed,
        ].join(" · ")),
      ].flat(),
    })
  }
}

// Scroll a list until all of an element is seen. After scrollIntoView(), Tab would go on from that element in newer
// browsers, and no longer begin at the top of the page.
function reveal(list, element) {
  const frame = list.getBoundingClientRect(), { left, right, top, bottom } = element.getBoundingClientRect()
  list.scrollBy(
    Math.floor(Math.min(0, left - frame.left)) || Math.ceil(Math.max(0, right - frame.right)),
    Math.floor(Math.min(0, top - frame.top)) || Math.ceil(Math.max(0, bottom - frame.bottom)),
  )
}

function isTyping(element) {
  return element.isContentEditable || element.matches?.("textarea, select, input:not([type=checkbox]):not([type=radio])")
}

function keysTable(name, keys) {
  const rows = keys.map(([key, act]) => h("tr", {}, h("th", { scope: "row" }, h("kbd", {}, key)), h("td", {}, act)))
  return h("table", { class: "keys", "aria-label": name }, h("tbody", {}, rows))
}
