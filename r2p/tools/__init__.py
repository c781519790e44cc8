"""The `r2p` command; it uses only the public API.

Read `main` (the table of commands) and `session` (how a command joins the network and ends) first, then any command:
`topic`, `node`, `module`, `bus`, `gateway`, `run`, `launch`, `config_show`, `doctor`, `sim` and `demo`. Commands
share `config` (settings and the file r2p.toml), `options`, `output` (stdout and stderr), `values` (messages as text),
`types` (which type a topic has) and `waiting` (until something is on the network).
"""
