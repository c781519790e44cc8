"""State machines without I/O: `now` (monotonic ns) and bytes come in, events and `next_deadline()` come out."""
