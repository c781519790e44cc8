"""Modules own nodes and links, and keep them going.

Read in this order:

    module        `r2p.Module`: opening and closing, starting nodes, its `log` topic, STOP and REBOOT
    supervisor    the life of one node: crash, restart, clean-up
    unwinding     detects a coroutine's clean-up, which must not be disturbed
    link_manager  the links of a module, and the handling of their reports
    graph         the network as the module knows it: `module.network`
    watchdog      reports code that blocks the event loop
    runner        `r2p.run`: a program of one module, with its signals
"""
