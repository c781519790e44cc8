"""Recordings ("bags"): MCAP files with messages, CAN frames, and what happened to them on their way.

`format` says what is in a file: start there. `samples` turns samples into records and back, with the classes of `types`
and the messages of `messages`; `writer` writes the records, and `bag` reads them. `recorder` subscribes to
topics and records them.
`player` publishes what is in a bag, by the publishers
of `played`, at the times that `pacing` keeps.
"""
