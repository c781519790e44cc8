"""Physics for emulated robots: small models with a state and `step(dt)`, in the units of data sheets.

`motor` (with its control and the battery), `world` (walls, range finders and a body on omni wheels), `differential` (a
body on two wheels), `pendulum` (one that balances on them), `inertial` (sensors and attitude) and `gps` are independent
of messages, event loops and clocks: time is the argument `dt`, randomness a `random.Random`. The modules of
`r2p.sim.modules` put nodes around these models, and a `Plant` steps them.
"""
