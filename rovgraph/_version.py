"""The version, which results, pages and exports carry."""

__version__ = "0.1.0"
