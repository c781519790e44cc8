// The overview: what `r2p top` shows.

export const overview = {
  id: "overview",
  title: "Overview",
  create(app) {
    const element = document.createElement("section")
    const list = document.createElement("ul")
    element.append(list)
    const draw = () => {
      list.replaceChildren(...[...app.store.topics.values()].map(topic => {
        const item = document.createElement("li")
        item.textContent = `${topic.name} ${topic.rate ?? "-"}`
        return item
      }))
    }
    return {
      element,
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
