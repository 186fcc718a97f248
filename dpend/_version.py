"""The version of the package, which files and stores record."""

__version__ = "0.1.0"
