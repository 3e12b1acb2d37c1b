"""What the paper's ablation tables print, by their labels: mean errors of the medium and of the fine level on Lucy."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["ABL_DELTA", "ABL_GRAD", "ABL_NORMAL", "ABL_SDF"]

# The paper's tables of the same labels: weight → (medium level, fine level) on Lucy.
ABL_GRAD: Mapping[float, tuple[float, float]] = MappingProxyType(
    {
        0: (0.0086, 0.0013),
        10: (0.0084, 0.0013),
        30: (0.0082, 0.0013),
        100: (0.0078, 0.0012),
        300: (0.0074, 0.0013),
        1000: (0.0069, 0.0014),
        3000: (0.0073, 0.0017),
        10000: (0.0087, 0.0022),
        30000: (0.0116, 0.0030),
    }
)
ABL_NORMAL: Mapping[float, tuple[float, float]] = MappingProxyType(
    {
        0: (0.0073, 0.0017),
        10: (0.0074, 0.0013),
        30: (0.0077, 0.0013),
        100: (0.0081, 0.0013),
        300: (0.0083, 0.0013),
        1000: (0.0085, 0.0013),
        3000: (0.0086, 0.0013),
        10000: (0.0087, 0.0013),
        30000: (0.0087, 0.0013),
    }
)
ABL_SDF: Mapping[float, tuple[float, float]] = MappingProxyType(
    {
        0: (0.0490, 0.0076),
        10: (0.0080, 0.0013),
        30: (0.0079, 0.0013),
        100: (0.0079, 0.0013),
        300: (0.0080, 0.0013),
        1000: (0.0081, 0.0012),
        3000: (0.0080, 0.0013),
        10000: (0.0082, 0.0013),
        30000: (0.0082, 0.0013),
    }
)
# Factor 1 + ε → (medium level, fine level).
ABL_DELTA: Mapping[float, tuple[float, float]] = MappingProxyType(
    {
        1.01: (0.0098, 0.0048),
        1.05: (0.0098, 0.0048),
        1.10: (0.0100, 0.0049),
        1.20: (0.0101, 0.0049),
        1.30: (0.0103, 0.0050),
        1.50: (0.0106, 0.0051),
        2.00: (0.0113, 0.0053),
        5.00: (0.0139, 0.0066),
    }
)
