"""Modules: what owns nodes and links, and keeps them going.

Read in this order:

    module        `r2p.Module`: opening and closing, starting nodes, its `log` topic, STOP and REBOOT
    supervisor    the life of one node: crash, restart, clean-up
    unwinding     whether a coroutine is in its clean-up, which must not be disturbed
    link_manager  what transports attach links to, and what happens with what they report
    graph         what the module knows of the network: `module.network`
    watchdog      which code blocks the event loop
    runner        `r2p.run`: a program of one module, with its signals
"""
