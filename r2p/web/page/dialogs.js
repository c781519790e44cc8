// Toasts and dialogs: errors, results, and questions to the user.

import { button, h } from "./dom.js"

const SHOWN = { good: 4_000, bad: 10_000 } // ms
const TOASTS_MAX = 4

// Show a message at the edge of the page; `kind` is "good" or "bad".
export function toast(text, kind = "good") {
  const list = document.getElementById("toasts")
  const same = [...list.children].find(each => each.dataset.text === text)
  same?.remove()
  const element = h("div", { class: `toast ${kind}`, dataset: { text } }, h("p", {}, text))
  element.append(button("Close", () => element.remove(), { class: "quiet", "aria-label": `Close: ${text}` }))
  list.append(element)
  while (list.children.length > TOASTS_MAX) list.firstElementChild.remove()
  setTimeout(() => element.remove(), SHOWN[kind])
}

// Wait for a request, and show why it failed, or else `done`. Returns the result, or undefined.
export async function attempt(promise, done = "") {
  try {
    const result = await promise
    if (done) toast(done)
    return result
  } catch (error) {
    toast(error.message, "bad")
    return undefined
  }
}

// Show a dialog, and return it. Escape, a click beside it and its button close it; `onclose` is called then.
export function openDialog({ title, body, actions = [], wide = false, onclose = () => {} }) {
  const heading = h("h2", { id: `dialog-${Math.random().toString(36).slice(2)}` }, title)
  const close = button("×", () => dialog.close(), { class: "quiet close", "aria-label": "Close", title: "Close (Esc)" })
  const dialog = h(
    "dialog",
    { class: wide ? "wide" : null, "aria-labelledby": heading.id },
    h("div", { class: "dialog-head" }, heading, close),
    h("div", { class: "dialog-body" }, body),
    actions.length ? h("div", { class: "dialog-actions" }, actions) : null,
  )
  dialog.addEventListener("click", event => event.target === dialog && dialog.close())
  dialog.addEventListener("close", () => {
    dialog.remove()
    onclose()
  })
  document.body.append(dialog)
  dialog.showModal()
  return dialog
}

// Ask before something that can't be undone; the promise is true if the user agrees.
export function confirmed(title, text, action, { danger = true } = {}) {
  return new Promise(resolve => {
    let agreed = false
    const agree = button(action, () => {
      agreed = true
      dialog.close()
    }, { class: danger ? "danger" : "primary" })
    const cancel = button("Cancel", () => dialog.close(), { autofocus: true })
    const dialog = openDialog({
      title, body: h("p", {}, text), actions: [cancel, agree], onclose: () => resolve(agreed),
    })
  })
}
