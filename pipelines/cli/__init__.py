"""The command line. Its files load what a command needs when it runs; none loads torch on import."""

from .entry import main

__all__ = ["main"]
