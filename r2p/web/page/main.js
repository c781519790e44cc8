// The page: its views, and which of them is shown. Each view is a module of its own, an object with
//   id, title       its address is #/ID or #/ID/ARGUMENT
//   keys            what help says of its keys: [["+ -", "zoom"], ...]; optional
//   available(hello)   whether this process has it; optional
//   create(app)     returns {element, show(argument), hide()}, once; and optionally key(event), which returns true
//                   for a key that it has used
// A control with `data-filter` takes the keyboard on "/", one with `data-pause` is pressed by "p" and the space bar.

import { Connection } from "./connection.js"
import { graph } from "./graph.js"
import { log } from "./log.js"
import { map } from "./map.js"
import { nodes } from "./nodes.js"
import { overview } from "./overview.js"
import { plots } from "./plots.js"
import { parameters } from "./parameters.js"
import { publish } from "./publish.js"
import { services } from "./services.js"
import { Shell } from "./shell.js"
import { slots } from "./slots.js"
import { Store } from "./store.js"

const VIEWS = [
  overview,
  plots,
  graph,
  slots,
  map,
  log,
  nodes,
  parameters,
  publish,
  services,
]

const connection = new Connection()
const app = {
  connection,
  store: new Store(connection),
  plotted: "", // the argument of the plots that are shown
  hello: null, // what the process allows: {recording, publish, control, ...}
  stats: { frames: 0, points: 0, redraws: 0 }, // what plots have done, in all
  has: id => VIEWS.some(view => view.id === id),
  address: (id, argument = "") => argument ? `#/${id}/${escape(argument)}` : `#/${id}`,
  open(id, argument = "") {
    location.hash = app.address(id, argument)
  },
  // Name the argument of the shown view without showing it anew: what the address bar keeps.
  rename(id, argument = "") {
    history.replaceState(null, "", app.address(id, argument))
  },
}

// Names stay readable in the address bar: what a hash may have is left as it is.
function escape(argument) {
  return encodeURIComponent(argument).replace(/%(2B|2F|2C|3A|3D|3B|40|5B|5D|24|28|29)/g, decodeURIComponent)
}

function unescape(argument) {
  try {
    return decodeURIComponent(argument)
  } catch {
    return argument
  }
}

const shell = new Shell(app, VIEWS)
const created = new Map()
let shown = null

function show() {
  const [, id = "", argument = ""] = location.hash.match(/^#\/([^/]*)(?:\/(.*))?$/) ?? []
  const view = VIEWS.find(each => each.id === id) ?? VIEWS[0]
  if (!created.has(view.id)) created.set(view.id, view.create(app))
  const next = created.get(view.id)
  if (next !== shown) {
    shown?.hide()
    document.getElementById("view").replaceChildren(next.element)
  }
  shown = next
  shell.shows(view, next)
  next.show(unescape(argument))
}

window.addEventListener("hashchange", show)
connection.addEventListener("hello", event => {
  app.hello = event.detail
  if (app.hello.recording) mountTimeline()
})

// A running network has no time line, so its pages do not load it.
async function mountTimeline() {
  const { timelineOf } = await import("./timeline.js")
  app.timeline ??= timelineOf(app)
}

window.r2p = app
shell.start()
connection.open()
show()
