"""A recording as the source of pages: `source` has what all pages share, and a `session` serves one of them.

The event loop never reads the file. A `reader` has a thread that does it in steps of one chunk, so a page that waits
for the file waits for the chunk of another one at most. A `scan` goes through the recording once, behind all else, and
keeps what happened, bounded; `figures` are those at an instant, from that scan and from the chunks before it. `plots`
and `log` read what a page asks for. Nothing waits for the scan: a page shows what is known so far.
"""
