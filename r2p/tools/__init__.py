"""The `r2p` command; it uses only the public API.

Read `main` (the table of commands) and `session` (how a command joins the network and ends) first, then any command:
`topic`, `node`, `module`, `bus`, `gateway`, `run`, `doctor`, `simulator` and `demo`. Commands share `options`, `output`
(stdout and stderr), `values` (messages as text) and `types` (which type a topic has).
"""
