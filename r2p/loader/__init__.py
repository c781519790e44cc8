"""The boot loader of firmware modules: list, load, remove and configure the apps in their flash (PROTOCOL.md 5).

`client` has `LoaderClient`, which does that for programs. It runs the generators of `procedures` in a `session`, the
state machine of the PC's side without I/O. `deploy` loads apps as a whole: `checks` before, reading back at the end.

What is loaded is an `image`, which `files` reads from HEX and ELF. Of an ELF file, `elf` takes what is needed,
`linking` gives it addresses, and `relocations` has what changes in the code for these.

It uses only what r2p offers to any program.
"""

from r2p.loader.client import LoaderClient
from r2p.loader.deploy import Deployment, LoadedApp
from r2p.loader.files import read_app
from r2p.loader.image import AppFileError, AppImage, LayoutError
from r2p.loader.procedures import AppListing, InstalledApp
from r2p.loader.session import LoaderConfused, LoaderError, LoaderFault, LoaderRefused, LoaderSilent

__all__ = [
    "AppFileError",
    "AppImage",
    "AppListing",
    "Deployment",
    "InstalledApp",
    "LayoutError",
    "LoadedApp",
    "LoaderClient",
    "LoaderConfused",
    "LoaderError",
    "LoaderFault",
    "LoaderRefused",
    "LoaderSilent",
    "read_app",
]
