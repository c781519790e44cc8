"""The network for Foxglove, Lichtblick and PlotJuggler: a server of the Foxglove WebSocket protocol.

`protocol` has its messages. `FoxgloveServer` (`server`) holds what all clients share, and a `FoxgloveSession`
(`session`) serves one of them.

channel_types   what a message class is to clients: a schema in `ros2msg`, and messages in CDR
channels        the topics of the network as channels, subscribed while a client wants them
publishing      what clients publish
services        services that clients call; parameters: those that they read and set
connections     which node publishes and subscribes to what
"""
