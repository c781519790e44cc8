"""How fast r2p is, each figure beside a peer or a bare baseline that ran in the same minute: `make bench`."""
