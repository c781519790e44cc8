// The overview: what `r2p top` shows.

import { filterBox, h, pauseButton } from "./dom.js"
import { count, fixed } from "./format.js"
import { LiveTable } from "./table.js"

const TOPICS = [
  { id: "topic", title: "Topic", value: topic => topic.name },
  { id: "type", title: "Type", level: 3, value: topic => topic.type, tone: () => "dim" },
  { id: "rate", title: "Rate", unit: "Hz", number: true, value: topic => topic.rate, text: topic => fixed(topic.rate) },
  { id: "size", title: "Size", unit: "B", number: true, level: 2, value: topic => topic.size,
    text: topic => count(topic.size) },
]

export const overview = {
  id: "overview",
  title: "Overview",
  create(app) {
    const table = new LiveTable({
      id: "topics", caption: "Topics", columns: TOPICS, key: topic => topic.name, sort: "-rate", empty: "No topics yet",
    })
    let paused = false
    const draw = () => paused || table.update(app.store.topics.values())
    const bar = h("div", { class: "bar" },
      h("h2", {}, "Topics"),
      filterBox("Filter topics", text => table.filter(text)),
      pauseButton(value => {
        paused = value
        draw()
      }))
    return {
      element: h("section", { class: "view" }, bar, table.element),
      show() {
        app.store.addEventListener("change", draw)
        draw()
      },
      hide() {
        app.store.removeEventListener("change", draw)
      },
    }
  },
}
