// Light or dark: a script of its own, and not a module, because it has to run before the first paint.

(() => {
  const KEY = "r2p-theme"
  const CHOICES = ["auto", "light", "dark"]
  const dark = matchMedia("(prefers-color-scheme: dark)")

  function read() {
    try {
      return localStorage.getItem(KEY) ?? "auto"
    } catch {
      return "auto" // the browser stores nothing for this page
    }
  }

  function write(choice) {
    try {
      localStorage.setItem(KEY, choice)
    } catch {
      // it is then valid until the page is left
    }
  }

  const theme = {
    choice: CHOICES.includes(read()) ? read() : "auto",

    apply() {
      const resolved = theme.choice === "auto" ? (dark.matches ? "dark" : "light") : theme.choice
      document.documentElement.dataset.theme = resolved
      document.dispatchEvent(new Event("theme"))
    },

    next() {
      theme.choice = CHOICES[(CHOICES.indexOf(theme.choice) + 1) % CHOICES.length]
      write(theme.choice)
      theme.apply()
    },
  }

  dark.addEventListener("change", theme.apply)
  window.r2pTheme = theme
  theme.apply()
})()
