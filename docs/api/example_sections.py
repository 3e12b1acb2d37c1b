"""For the site: griffe reads ``Examples:``; our docstrings say ``Example:``, which the Google style allows as well."""

import re
from typing import Any

import griffe


class ExampleSections(griffe.Extension):
    """Takes ``Example:`` for ``Examples:`` in every docstring."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename the section before the docstring is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
