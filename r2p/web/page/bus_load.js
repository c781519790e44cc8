// The load of a bus as a bar: what each kind of traffic takes, and a line where the share ends that slots have reserved.

import { h } from "./dom.js"
import { percent } from "./format.js"

const NAMES = {
  sync: "sync", hrt: "periodic", srt: "sporadic", nrt: "non real-time", management: "management", other: "not RTCAN",
}

export const kindName = kind => NAMES[kind] ?? kind
export const kindClass = kind => `kind-${NAMES[kind] ? kind : "other"}`

// Return [kind, share] of what is on a bus, always in the same order.
export function sharesOf(bus) {
  const shares = new Map()
  for (const { kind, share } of bus.topics ?? []) shares.set(kind, (shares.get(kind) ?? 0) + share)
  const order = [...Object.keys(NAMES), ...shares.keys()]
  return [...new Set(order)].filter(kind => shares.get(kind) > 0).map(kind => [kind, shares.get(kind)])
}

export class LoadBar {
  element = h("div", { class: "load", role: "img" })

  update(bus) {
    const shares = sharesOf(bus).map(([kind, share]) => [kind, share, `${kindName(kind)} ${percent(share)} %`])
    const parts = shares.map(([kind, share, title]) => {
      const part = h("span", { class: `part ${kindClass(kind)}`, title })
      part.style.width = `${Math.min(100, 100 * share)}%`
      return part
    })
    this.element.replaceChildren(...parts, ...(bus.reserved === undefined ? [] : [reservedLine(bus.reserved)]))
    this.element.setAttribute("aria-label",
      `Load ${percent(bus.share)} %, reserved for slots ${percent(bus.reserved)} %: ${shares.map(each => each[2]).join(", ")}`)
  }
}

function reservedLine(share) {
  const line = h("span", { class: "mark", title: `reserved for slots: ${percent(share)} %` })
  line.style.left = `${Math.min(100, 100 * share)}%`
  return line
}
