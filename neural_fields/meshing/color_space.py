"""Display colours (sRGB-encoded, what PNG files hold) ↔ linear light, by the exact curves of IEC 61966-2-1."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = TypeVar("Floats", NDArray[np.float32], NDArray[np.float64])

# Where the straight piece near black meets the power curve, on either side.
KNEE_DISPLAY, KNEE_LINEAR = 0.04045, 0.0031308


def srgb_to_linear(x: Floats) -> Floats:
    """Display numbers in [0, 1] → linear light: ``x / 12.92`` up to 0.04045, else ``((x + 0.055) / 1.055)^2.4``.

    Linear light is what may be averaged: half of the light of white is 0.735 on the display, not 0.5.
    """
    light: Any = np.where(x <= KNEE_DISPLAY, x / 12.92, ((np.maximum(x, KNEE_DISPLAY) + 0.055) / 1.055) ** 2.4)
    return light


def linear_to_srgb(x: Floats) -> Floats:
    """Linear light in [0, 1] → display numbers; the inverse of `srgb_to_linear`."""
    display: Any = np.where(x <= KNEE_LINEAR, x * 12.92, 1.055 * np.maximum(x, KNEE_LINEAR) ** (1 / 2.4) - 0.055)
    return display
