"""``evolve`` and ``animate``: surfaces that move."""

from .train import evolve

__all__ = ["evolve"]
