// When to ask again for what no module of the network has answered: soon at first, and then more and more rarely.

const PAUSE = 500 // ms after the first failure
const DOUBLED = 5 // times at most: 16 s

export class Retries {
  #failures = 0
  #at = Infinity

  // Whether it is time; the views look with each of the next figures.
  get due() {
    return performance.now() >= this.#at
  }

  reset() {
    this.#failures = 0
    this.begin()
  }

  // One attempt at a time.
  begin() {
    this.#at = Infinity
  }

  fail() {
    this.#at = performance.now() + PAUSE * 2 ** Math.min(this.#failures++, DOUBLED)
  }
}
