"""Parameters: values of a node that can be read, set and saved while it runs (PROTOCOL.md 9).

Read in this order:

    values       the kinds of value, what converts to them, and what they may be at most
    definition   what a program declares: kind, limits, texts; and `ParameterInfo`, which describes it for others
    sources      where values come from, and which one wins
    file         the file that values are saved to
    parameter    `Parameter`, what `Node.parameter` returns
    registry     the parameters of a module: declared, set all or nothing, reset, saved

Nothing here knows a wire: `r2p.modules.parameter_services` answers other modules, with `r2p.codecs.parameters`.
"""
