"""The one error type that means: what the user gave us cannot be used."""

from __future__ import annotations

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input: a file, a field in it, or a flag.

    The message is one line that names the file (or flag), what is wrong with it, and the fix.
    The command line prints it as it is and exits with code 2; anything else is a defect of ours.
    """
