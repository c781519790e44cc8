// Figures as text. What is not known is "-", never 0; units are in the heads of tables.

export const UNKNOWN = "-"

// Return a number with as many digits as say something: 0.0123, 1.23, 12.3, 1234.
export function number(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return UNKNOWN
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "-∞"
  const size = Math.abs(value)
  if (size !== 0 && (size < 1e-4 || size >= 1e9)) return value.toExponential(digits - 1)
  const before = size < 1 ? 1 : Math.floor(Math.log10(size)) + 1
  return value.toFixed(Math.max(0, size < 1 && size > 0 ? digits + Math.ceil(-Math.log10(size)) - 1 : digits - before))
}

// Return a value with the given number of decimals.
export function fixed(value, decimals = 1) {
  return value === null || value === undefined ? UNKNOWN : value.toFixed(decimals)
}

export function count(value) {
  return value === null || value === undefined ? UNKNOWN : String(Math.round(value))
}

// Return a share (1.0 is all) in percent, without the sign.
export function percent(share, decimals = 1) {
  return share === null || share === undefined ? UNKNOWN : (100 * share).toFixed(decimals)
}

// Return s as ms.
export function milliseconds(seconds, decimals = 2) {
  return seconds === null || seconds === undefined ? UNKNOWN : (1000 * seconds).toFixed(decimals)
}

// Return bytes per second as kB/s.
export function kilobytes(value, decimals = 1) {
  return value === null || value === undefined ? UNKNOWN : (value / 1000).toFixed(decimals)
}

const STEPS = [[86_400, "d"], [3_600, "h"], [60, "min"], [1, "s"]]

// Return how long something is or was: "0.4 s", "3 min", "2 h".
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return UNKNOWN
  const [unit, name] = STEPS.find(([size]) => seconds >= size) ?? [1, "s"]
  const value = seconds / unit
  return `${value < 10 && unit === 1 ? value.toFixed(1) : Math.floor(value)} ${name}`
}

// Return the time of day of a time in ns (UTC) or s.
export function clock(seconds, decimals = 0) {
  const date = new Date(seconds * 1000)
  const two = value => String(value).padStart(2, "0")
  const whole = `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`
  const fraction = (seconds - Math.floor(seconds)).toFixed(Math.min(decimals, 6)).slice(1)
  return decimals ? whole + fraction : whole
}

// Return the sum of what is known, or null if nothing is.
export function total(values) {
  const known = values.filter(value => value !== null && value !== undefined)
  return known.length ? known.reduce((sum, value) => sum + value, 0) : null
}

// Return how many of something: plural(2, "topic") is "2 topics".
export function plural(size, name, names = `${name}s`) {
  return `${size} ${size === 1 ? name : names}`
}
