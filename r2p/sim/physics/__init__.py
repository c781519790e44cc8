"""Physics for emulated robots: small models, each a state and `step(dt)`, in the units of data sheets.

Nothing here knows of messages, event loops or clocks: time comes in as `dt`, randomness as a `random.Random`. The
modules of `r2p.sim.modules` put nodes around these models; `r2p.sim.modules.plant` moves them on.
"""
