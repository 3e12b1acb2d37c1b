"""The most memory that a process has held: its own, not its parent's."""

import inspect
import subprocess
import sys

import numpy as np
import pytest
from mplicits.neural_fields.backend.devices import STATUS, peak_memory


def test_what_was_held_is_counted_and_stays() -> None:
    held = np.ones(2**27, np.uint8)
    during = peak_memory()
    if during is None:
        pytest.skip("this system does not keep it")
    size = held.nbytes
    del held
    after = peak_memory()
    # Not one against the other: the kernel counts pages per processor, and adds them up now and then.
    assert min(during, after) > size


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere nothing survives exec")
def test_a_child_does_not_inherit_its_parents_peak() -> None:
    # Its source in a bare interpreter, which needs some 10 MiB; this one holds 256 MiB more when the child is born.
    program = f"import sys\nfrom pathlib import Path\nSTATUS = Path({str(STATUS)!r})\n{inspect.getsource(peak_memory)}"
    held = np.ones(2**28, np.uint8)
    command = [sys.executable, "-S", "-E", "-c", f"{program}\nprint(peak_memory())"]
    child = subprocess.run(command, check=True, capture_output=True, text=True)
    assert int(child.stdout) < held.nbytes // 4
