"""The figures that the paper prints, by its own labels of the tables.

Rows are named as the outputs are here. Chamfer distances are squared L2, both ways; "IoU" is the overlap of surface
voxels (`shell_iou`). All were measured on an RTX 5090, on Stanford and Thingi32 shapes. The ablations were measured
on Lucy, and have the mean errors of the medium and of the fine level.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class NoiseRow(NamedTuple):
    """Chamfer distances and IoUs over all shapes."""

    mean_chamfer: float
    median_chamfer: float
    mean_iou: float
    median_iou: float


class ComparisonRow(NamedTuple):
    """The same on clean clouds, and what it costs."""

    mean_chamfer: float
    median_chamfer: float
    mean_iou: float
    median_iou: float
    parameters: int
    training_minutes: float
    sampling_seconds: float
    frames_per_second: float | None


# t-comparison
COMPARISON: Mapping[str, ComparisonRow] = MappingProxyType(
    {
        "iNGP coarse": ComparisonRow(6.87e-5, 6.43e-5, 0.412, 0.405, 2_040_864, 8.22, 0.40, 86),
        "iNGP fine": ComparisonRow(6.44e-5, 6.04e-5, 0.420, 0.390, 9_113_760, 10.59, 0.89, 88),
        "IDF": ComparisonRow(6.13e-2, 7.74e-4, 0.409, 0.0920, 1_191_943, 8.26, 42.38, None),
        "BACON": ComparisonRow(8.12e-3, 2.18e-5, 0.515, 0.732, 530_953, 8.43, 0.24, None),
        "Ours coarse": ComparisonRow(5.36e-5, 3.80e-5, 0.448, 0.459, 17_153, 4.07, 1.51, 180),
        "Ours fine": ComparisonRow(6.57e-5, 1.87e-5, 0.586, 0.867, 246_627, 8.53, 5.29, 43),
    }
)

# table:noise_comparison
NOISE: Mapping[str, NoiseRow] = MappingProxyType(
    {
        "Ours coarse": NoiseRow(7.42e-5, 5.33e-5, 0.381, 0.403),
        "Ours medium": NoiseRow(4.62e-5, 3.03e-5, 0.537, 0.638),
        "Ours fine": NoiseRow(3.36e-5, 1.62e-5, 0.582, 0.591),
        "iNGP coarse": NoiseRow(6.70e-4, 3.76e-4, 0.190, 0.188),
        "iNGP fine": NoiseRow(2.80e-4, 1.09e-4, 0.309, 0.305),
        "IDF": NoiseRow(8.37e-2, 2.49e-5, 0.322, 0.308),
        "BACON": NoiseRow(1.68e-3, 1.51e-4, 0.176, 0.165),
    }
)

# tab:spsr: (output, noise) → mean Chamfer distance and mean IoU over ten shapes; of screened Poisson without its trim
# the text beside the table gives the IoU only.
POISSON: Mapping[tuple[str, float], tuple[float | None, float]] = MappingProxyType(
    {
        ("Screened Poisson (1% trim)", 0.0): (7.16e-5, 0.910),
        ("Screened Poisson (1% trim)", 0.01): (9.98e-5, 0.416),
        ("Screened Poisson", 0.0): (None, 0.867),
        ("Screened Poisson", 0.01): (None, 0.394),
        ("Ours fine", 0.0): (3.87e-5, 0.653),
        ("Ours fine", 0.01): (6.39e-5, 0.687),
    }
)

# tab:banf: shape → Chamfer distances of ours clean, BANF clean, ours with noise, BANF with noise
BANF: Mapping[str, tuple[float, float, float, float]] = MappingProxyType(
    {
        "dragon": (8.65e-6, 3.03e-4, 8.69e-6, 3.20e-4),
        "armadillo": (7.41e-5, 2.79e-5, 1.38e-5, 2.03e-4),
        "lucy": (2.18e-5, 1.03e-4, 3.33e-5, 1.18e-2),
        "thai": (1.94e-4, 8.27e-5, 4.90e-4, 1.07e-2),
    }
)

# tab:undertrained: (shape, part of the coarse stage's epochs) → δ₁ and the final Chamfer distance
UNDERTRAINED: Mapping[tuple[str, float], tuple[float, float]] = MappingProxyType(
    {
        ("armadillo", 0.25): (6.20e-2, 1.11e-5),
        ("armadillo", 0.5): (2.00e-2, 1.06e-4),
        ("armadillo", 1.0): (1.71e-2, 9.81e-5),
        ("lucy", 0.25): (2.83e-2, 7.13e-5),
        ("lucy", 0.5): (2.70e-2, 5.03e-5),
        ("lucy", 1.0): (2.94e-2, 5.24e-5),
    }
)

# tab:outliers: (shape, strays as a fraction of the points) → IoU of ours, of screened Poisson, and of it with its trim
OUTLIERS: Mapping[tuple[str, float], tuple[float, float, float]] = MappingProxyType(
    {
        ("armadillo", 0.001): (0.909, 0.982, 0.978),
        ("armadillo", 0.01): (0.863, 0.985, 0.981),
        ("lucy", 0.001): (0.799, 0.995, 0.986),
        ("lucy", 0.01): (0.002, 0.004, 0.938),
    }
)

# tab:deltas: shape → δ₁ and δ₂ on clean clouds; of the noisy Thai Statue the text gives 6.9e-2 and 5.2e-2.
DELTAS: Mapping[tuple[str, float], tuple[float, float]] = MappingProxyType(
    {
        ("armadillo", 0.0): (1.68e-2, 1.11e-2),
        ("dragon", 0.0): (2.93e-2, 1.65e-2),
        ("lucy", 0.0): (2.67e-2, 1.43e-2),
        ("thai", 0.0): (2.71e-2, 1.57e-2),
        ("thai", 0.01): (6.9e-2, 5.2e-2),
    }
)


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

# tab:isolation: variant → mean CD, median CD, mean Hausdorff, mean IoU; with noise, then clean.
TAB_ISOLATION: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = MappingProxyType(
    {
        "a": ((6.39e-5, 1.49e-5, 1.45e-3, 0.687), (3.87e-5, 1.38e-5, 5.86e-3, 0.653)),
        "b": ((6.34e-5, 2.26e-5, 5.23e-3, 0.555), (4.26e-5, 2.36e-5, 6.75e-3, 0.655)),
        "c": ((1.04e-4, 2.36e-5, 5.72e-3, 0.669), (3.47e-5, 1.62e-5, 4.01e-3, 0.749)),
    }
)
# In the text below it: mean CD with noise, extracted without culling.
CD_WITHOUT_CULLING: Mapping[str, float] = MappingProxyType({"a": 6.42e-5, "c": 2.8e-1})
COMPONENTS: Mapping[str, str] = MappingProxyType({"a": "1 to 4", "c": "365 to 4,109"})

# tab:time_mc: model → seconds at 512³: baseline, without culling, with it.
TIME_MC: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {
        "Armadillo": (4.87, 4.10, 0.99),
        "Lucy": (4.87, 7.49, 1.07),
        "Dragon": (4.88, 7.28, 1.71),
        "Thai": (4.89, 7.28, 1.73),
    }
)
# tab:time_auto: (model, hidden layers of 256, side of the image) → autograd, theirs, in seconds.
TIME_AUTO: Mapping[tuple[str, int, int], tuple[float, float]] = MappingProxyType(
    {
        ("Armadillo", 2, 512): (0.007, 0.003),
        ("Armadillo", 2, 1024): (0.024, 0.010),
        ("Armadillo", 3, 512): (0.010, 0.005),
        ("Armadillo", 3, 1024): (0.025, 0.012),
        ("Buddha", 2, 512): (0.008, 0.005),
        ("Buddha", 2, 1024): (0.021, 0.014),
        ("Buddha", 3, 512): (0.011, 0.005),
        ("Buddha", 3, 1024): (0.024, 0.012),
        ("Lucy", 2, 512): (0.007, 0.004),
        ("Lucy", 2, 1024): (0.021, 0.012),
        ("Lucy", 3, 512): (0.011, 0.007),
        ("Lucy", 3, 1024): (0.025, 0.015),
    }
)
PAPER_MODELS = ("Armadillo", "Buddha", "Lucy")
