// Elements, and nothing else: names come from the network, so text is only ever set as text, never as HTML.

// Create an element: h("button", { class: "quiet", type: "button", onclick: act, disabled: false }, "Stop").
// Properties that begin with "on" are listeners; true and false set and leave out an attribute, null leaves it out.
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag)
  for (const [name, value] of Object.entries(properties)) set(element, name, value)
  element.append(...children.flat().filter(each => each !== null && each !== undefined))
  return element
}

function set(element, name, value) {
  if (name.startsWith("on")) element.addEventListener(name.slice(2), value)
  else if (name === "value" || name === "checked") element[name] = value
  else if (name === "dataset") Object.assign(element.dataset, value)
  else if (value === true) element.setAttribute(name, "")
  else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value)
}

// Set the text of an element if it differs: a page of a thousand rows changes only what has changed.
export function setText(element, text) {
  const wanted = String(text)
  if (element.textContent !== wanted) element.textContent = wanted
}

// Make these the children of an element, in this order. Those that stay are not taken out and put back, as they would lose
// the keyboard then, and a click would be lost that has begun; unless their order changes.
export function place(parent, elements) {
  const wanted = new Set(elements)
  for (const child of [...parent.children]) if (!wanted.has(child)) child.remove()
  let at = parent.firstElementChild
  for (const element of elements) {
    if (element === at) at = at.nextElementSibling
    else parent.insertBefore(element, at)
  }
}

// Show newer content: elements that were made anew, without listeners. Of what is shown only what differs is changed, so
// that a link in it keeps the keyboard, and a click that has begun.
export function renew(parent, ...elements) {
  const before = [...parent.childNodes]
  for (const [index, fresh] of elements.entries()) {
    if (index < before.length) renewNode(before[index], fresh)
    else parent.append(fresh)
  }
  for (const old of before.slice(elements.length)) old.remove()
}

function renewNode(old, fresh) {
  if (old.isEqualNode(fresh)) return
  if (old.nodeName !== fresh.nodeName || !fresh.attributes) return old.replaceWith(fresh)
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name)) old.removeAttribute(name)
  for (const { name, value } of fresh.attributes) old.setAttribute(name, value)
  renew(old, ...fresh.childNodes)
}

export function button(text, act, properties = {}) {
  return h("button", { type: "button", onclick: act, ...properties }, text)
}

let labels = 0

// Return a label and its control, which it names.
export function field(text, control, { hidden = false } = {}) {
  control.id ||= `control-${++labels}`
  return h("div", { class: "field" }, h("label", { for: control.id, class: hidden ? "sr-only" : null }, text), control)
}

// Return a filter: "/" takes the keyboard there, Escape empties it.
export function filterBox(label, change) {
  const input = h("input", {
    type: "search",
    placeholder: "Filter",
    "aria-label": label,
    "aria-keyshortcuts": "/",
    autocomplete: "off",
    spellcheck: "false",
    dataset: { filter: "" },
    oninput: () => change(input.value),
    onkeydown: event => {
      if (event.key !== "Escape") return
      event.stopPropagation()
      input.value = ""
      change("")
      input.blur()
    },
  })
  return input
}

// Return a button that "p" and the space bar press too; `change(paused)` is called.
export function pauseButton(change) {
  const element = button("Pause", () => {
    const paused = element.getAttribute("aria-pressed") !== "true"
    element.setAttribute("aria-pressed", paused)
    element.textContent = paused ? "Resume" : "Pause"
    change(paused)
  }, { "aria-pressed": "false", "aria-keyshortcuts": "p", title: "Pause or resume (p)", dataset: { pause: "" } })
  return element
}

// Return a colour of the theme as canvases need it: color("--accent").
export function color(variable) {
  return getComputedStyle(document.documentElement).getPropertyValue(variable).trim()
}

// Save text or bytes as a file of the user.
export function download(name, parts, type) {
  const url = URL.createObjectURL(new Blob(parts, { type }))
  h("a", { href: url, download: name }).click()
  setTimeout(() => URL.revokeObjectURL(url), 10_000)
}

// Call `act` once before the next frame, however often it is asked to.
export function oncePerFrame(act) {
  let asked = false
  return () => {
    if (asked) return
    asked = true
    requestAnimationFrame(() => {
      asked = false
      act()
    })
  }
}

// What a page remembers from one visit to the next; nothing, where the browser stores nothing.
export const memory = {
  get(key, otherwise) {
    try {
      return JSON.parse(localStorage.getItem(`r2p-${key}`)) ?? otherwise
    } catch {
      return otherwise
    }
  },
  set(key, value) {
    try {
      localStorage.setItem(`r2p-${key}`, JSON.stringify(value))
    } catch {
      // it is then valid until the page is left
    }
  },
}
