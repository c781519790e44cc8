"""Units of time, and instants beyond any clock. Instants and durations are nanoseconds, as `int`.

Apart from `r2p.clock`, which codecs and protocols must not import: they get the time as an argument.
"""

MILLISECOND = 1_000_000
SECOND = 1_000_000_000

NEVER = 1 << 62
"""An instant after all others: it never arrives."""
LONG_AGO = -NEVER
"""An instant before all others."""
