"""The boot loader of firmware modules: list, load, remove and configure the apps in their flash (PROTOCOL.md 5).

`client` has `LoaderClient`, which does that for programs. It runs the generators of `procedures` in a `session`, the
state machine of the PC's side without I/O. It uses only what r2p offers to any program.
"""

from r2p.loader.client import LoaderClient
from r2p.loader.procedures import AppListing, InstalledApp
from r2p.loader.session import LoaderConfused, LoaderError, LoaderRefused, LoaderSilent

__all__ = [
    "AppListing",
    "InstalledApp",
    "LoaderClient",
    "LoaderConfused",
    "LoaderError",
    "LoaderRefused",
    "LoaderSilent",
]
