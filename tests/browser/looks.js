// What is wrong with the view that is shown, as texts: a function for Playwright's evaluate.
() => {
  const TEXT = 4.5, LARGE = 3 // contrast, as WCAG 2.2 AA asks for
  const TARGET = 24 // px, the least size of a control
  const CONTROLS = "a[href], button, input, select, textarea, summary, [tabindex='0'], [role=button], [role=tab]"
  const problems = []

  const name = element => {
    const own = element.id ? `#${element.id}` : [...element.classList].map(each => `.${each}`).join("")
    return `<${element.localName}${own}> ${element.textContent.trim().replace(/\s+/g, " ").slice(0, 40)}`.trim()
  }
  const report = (what, element) => problems.push(element ? `${what}: ${name(element)}` : what)
  const isShown = element => {
    const box = element.getBoundingClientRect() // of one pixel is what only screen readers get
    const isVisible = element.checkVisibility({ opacityProperty: true, visibilityProperty: true })
    return isVisible && (box.width > 1 || box.height > 1)
  }
  const all = selector => [...document.querySelectorAll(selector)].filter(isShown)

  // Colours

  const context = document.createElement("canvas").getContext("2d", { willReadFrequently: true })
  const parse = colour => {
    context.clearRect(0, 0, 1, 1)
    context.fillStyle = colour
    context.fillRect(0, 0, 1, 1)
    const [red, green, blue, alpha] = context.getImageData(0, 0, 1, 1).data
    return [red, green, blue, alpha / 255]
  }
  const over = (front, back) => [0, 1, 2].map(i => front[i] * front[3] + back[i] * (1 - front[3])).concat(1)
  const background = element => {
    const layers = []
    for (let each = element; each; each = each.parentElement) {
      const colour = parse(getComputedStyle(each).backgroundColor)
      layers.push(colour)
      if (colour[3] === 1) break
    }
    return layers.reverse().reduce((back, front) => over(front, back), [255, 255, 255, 1])
  }
  const luminance = colour => {
    const [red, green, blue] = colour.slice(0, 3).map(each => each / 255)
      .map(each => each <= 0.04045 ? each / 12.92 : ((each + 0.055) / 1.055) ** 2.4)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
  }
  const contrast = (front, back) => {
    const [dark, light] = [luminance(front), luminance(back)].sort((a, b) => a - b)
    return (light + 0.05) / (dark + 0.05)
  }
  const opacity = element => {
    let product = 1
    for (let each = element; each; each = each.parentElement) product *= getComputedStyle(each).opacity
    return product
  }
  const checkContrast = (element, pseudo) => {
    const style = getComputedStyle(element, pseudo)
    const back = background(element)
    const colour = parse(element instanceof SVGElement ? style.fill : style.color)
    const ratio = contrast(over([...colour.slice(0, 3), colour[3] * opacity(element)], back), back)
    const size = parseFloat(style.fontSize)
    const wanted = size >= 24 || (size >= 18.66 && style.fontWeight >= 700) ? LARGE : TEXT
    if (ratio < wanted - 0.01) report(`contrast ${ratio.toFixed(2)} instead of ${wanted}`, element)
  }
  const seen = new Set()
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT)
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement
    if (!walker.currentNode.data.trim() || seen.has(element) || !isShown(element)) continue
    seen.add(element)
    if (!element.closest(":disabled, [aria-disabled=true], option")) checkContrast(element)
  }
  for (const element of all("input[placeholder]:placeholder-shown")) checkContrast(element, "::placeholder")

  // Layout: nothing is cut off at the side, and fingers can hit what they should

  if (document.documentElement.scrollWidth > innerWidth) report("the page scrolls sideways")
  const isScrolled = element => {
    for (let each = element.parentElement; each; each = each.parentElement) {
      if (["auto", "scroll"].includes(getComputedStyle(each).overflowX)) return true
    }
    return false
  }
  for (const element of all("body *")) {
    const box = element.getBoundingClientRect()
    const isOut = box.width > 1 && (box.right > innerWidth + 1 || box.left < -1)
    const isOwn = !(element instanceof SVGElement) || element.localName === "svg"
    if (isOut && isOwn && !isScrolled(element) && !element.matches(".skip")) report("cut off at the side", element)
  }
  for (const element of all(CONTROLS)) {
    const boxes = [element, element.closest("label") ?? element].map(each => each.getBoundingClientRect())
    const width = Math.max(...boxes.map(each => each.width)), height = Math.max(...boxes.map(each => each.height))
    const isInText = getComputedStyle(element).display === "inline" || element.matches(".skip")
    if (!isInText && (width < TARGET || height < TARGET) && !(element instanceof SVGElement))
      report(`${width.toFixed(0)}x${height.toFixed(0)} px is too small to hit`, element)
  }

  // Structure

  const ids = [...document.querySelectorAll("[id]")].map(each => each.id)
  for (const id of new Set(ids.filter((each, index) => ids.indexOf(each) !== index))) report(`two elements have the id ${id}`)
  for (const attribute of ["aria-labelledby", "aria-describedby", "aria-controls", "for", "list"]) {
    for (const element of document.querySelectorAll(`[${attribute}]`)) {
      for (const id of element.getAttribute(attribute).split(/\s+/).filter(Boolean))
        if (!document.getElementById(id)) report(`${attribute} names ${id}, which is not there`, element)
    }
  }
  let level = 0
  for (const heading of all("h1, h2, h3, h4, h5, h6")) {
    const own = Number(heading.localName[1])
    if (own > level + 1) report(`a heading h${own} after h${level}`, heading)
    level = own
  }
  if (document.querySelectorAll("h1").length !== 1) report(`${document.querySelectorAll("h1").length} headings h1`)
  if (all("main").length !== 1) report(`${all("main").length} elements main`)
  if (!document.documentElement.lang) report("the page has no language")
  if (!document.title) report("the page has no title")
  for (const element of all("[tabindex]")) if (element.tabIndex > 0) report("its own place in the order of Tab", element)
  for (const element of all("table")) {
    if (!element.querySelector("th")) report("a table without heads", element)
    if (!element.querySelector("caption") && !element.ariaLabel && !element.hasAttribute("aria-labelledby"))
      report("a table without a name", element)
  }
  for (const element of all("canvas")) {
    if (!element.closest("[aria-label], [aria-labelledby], [aria-hidden=true]")) report("a canvas without a name", element)
  }
  for (const element of all("th button")) {
    if (!element.closest("table").querySelector("th[aria-sort]")) report("a table that does not say how it is sorted", element)
  }
  for (const element of all("a button, button a, button button, a a, label button")) report("a control in a control", element)
  return problems
}
