from types import SimpleNamespace

import pytest
from mplicits.neural_fields.backend.kernels.launch import resident_programs

HOPPER = SimpleNamespace(shared_memory_per_multiprocessor=228 << 10, max_threads_per_multi_processor=2048)
ADA = SimpleNamespace(shared_memory_per_multiprocessor=100 << 10, max_threads_per_multi_processor=1536)


@pytest.mark.parametrize(
    ("registers", "shared", "warps", "device", "expected"),
    [
        (168, 66048, 4, HOPPER, 3),  # 168 · 128 · 3 registers, and 3 · 65.5 KiB
        (169, 66048, 4, HOPPER, 2),  # registers are given out by eights: 176 · 128 · 3 are too many
        (255, 197632, 8, HOPPER, 1),  # one by either
        (32, 0, 4, HOPPER, 16),  # 64 warps
        (32, 0, 4, ADA, 12),  # 48 warps
        (64, 50 << 10, 4, ADA, 1),  # each program takes 1 KiB more
        (255, 300 << 10, 8, HOPPER, 1),  # more than there is: the launch itself will say so
    ],
)
def test_programs_of_a_multiprocessor(registers, shared, warps, device, expected) -> None:
    assert resident_programs(registers, shared, warps, device) == expected
