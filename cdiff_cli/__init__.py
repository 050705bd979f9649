"""Safe planning with diffusion models: constraints as YAML in, trajectories that satisfy them out."""

from cdiff_cli.version import __version__

__all__ = ["__version__"]
