"""The version of r2p, apart from the package: protocols announce it, and import nothing above them."""

__version__ = "0.1.0"
