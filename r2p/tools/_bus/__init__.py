"""What the commands of `r2p bus` share."""
