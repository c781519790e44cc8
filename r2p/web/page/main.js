// The page: its views, and which of them is shown. Each view is a module of its own, with `id`, `title` and
// `create(app)`, which returns {element, show(argument), hide()}. Its address is #/ID or #/ID/ARGUMENT.

import { Connection } from "./connection.js"
import { overview } from "./overview.js"
import { Store } from "./store.js"

const VIEWS = [overview]

const connection = new Connection()
const app = { connection, store: new Store(connection), hello: null, open: (id, argument = "") => {
  location.hash = `#/${id}/${encodeURIComponent(argument)}`
} }
const created = new Map()
let shown = null

function show() {
  const [, id, argument] = location.hash.split("/")
  const view = VIEWS.find(each => each.id === id) ?? VIEWS[0]
  if (!created.has(view.id)) created.set(view.id, view.create(app))
  shown?.hide()
  shown = created.get(view.id)
  document.getElementById("view").replaceChildren(shown.element)
  for (const link of document.querySelectorAll("#views a"))
    link.toggleAttribute("aria-current", link.dataset.view === view.id)
  shown.show(decodeURIComponent(argument ?? ""))
}

for (const view of VIEWS) {
  const link = document.createElement("a")
  link.href = `#/${view.id}`
  link.dataset.view = view.id
  link.textContent = view.title
  document.getElementById("views").append(link)
}

const state = document.getElementById("state")
connection.addEventListener("hello", event => {
  app.hello = event.detail
  state.textContent = "connected"
  document.title = document.getElementById("title").textContent = event.detail.title || "r2p"
})
connection.addEventListener("lost", event => {
  state.textContent = event.detail || "connection lost: trying again"
})
window.addEventListener("hashchange", show)
window.r2p = app
connection.open()
show()
