"""The version of the package, for `cdiff --version`, `cdiff_cli.__version__` and the build."""

__version__ = "0.1.0"
