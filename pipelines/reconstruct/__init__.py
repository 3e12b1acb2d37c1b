"""``reconstruct``: from posed photographs to a surface with colours."""

from .train import reconstruct

__all__ = ["reconstruct"]
