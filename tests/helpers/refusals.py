"""How bad input is refused: in one line that names the file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mplicits.neural_fields import InputError


@contextmanager
def refused(named: Path | str, match: str) -> Iterator[None]:
    """A block that must raise an `InputError` of one line with ``named`` in it, in which ``match`` is found."""
    with pytest.raises(InputError, match=match) as caught:
        yield
    assert str(named) in str(caught.value)
    assert "\n" not in str(caught.value)
