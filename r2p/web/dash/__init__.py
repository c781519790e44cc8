"""The page of `r2p dash`: what it shows of a running network, or of a recording.

`protocol` has the messages between page and process. A `session` serves one page from a `source`: a `live` network, or
a recording. The page itself is `r2p/web/page`: plain modules of JavaScript without a build step.
"""
