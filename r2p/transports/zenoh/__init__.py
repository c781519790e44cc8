"""zenoh as a transport: between PCs, over any network that zenoh reaches."""
