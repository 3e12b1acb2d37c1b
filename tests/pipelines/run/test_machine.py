"""The most memory that a process has held: its own, not its parent's."""

import subprocess
import sys

import numpy as np
import pytest
from mplicits.pipelines.run.machine import peak_memory

CHILD = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("memory", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(module.peak_memory())
"""


def test_what_was_held_is_counted_and_stays() -> None:
    held = np.ones(2**27, np.uint8)
    during = peak_memory()
    if during is None:
        pytest.skip("this system does not keep it")
    size = held.nbytes
    del held
    after = peak_memory()
    assert after is not None
    # Not one against the other: the kernel counts pages per processor, and adds them up now and then.
    assert min(during, after) > size


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere nothing survives exec")
def test_a_child_does_not_inherit_its_parents_peak() -> None:
    held = np.ones(2**28, np.uint8)
    module = sys.modules[peak_memory.__module__].__file__
    assert module is not None
    # -S -E: a bare interpreter needs some 10 MiB; the parent holds 256 MiB more than that when the child is born.
    child = subprocess.run(
        [sys.executable, "-S", "-E", "-c", CHILD, module], check=True, capture_output=True, text=True, close_fds=False
    )
    assert int(child.stdout) < held.nbytes // 4
