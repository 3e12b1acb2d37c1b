"""What the tests of pages show: a small field with colours, whose exact values are known, and patience."""

import time

import torch
from mplicits.neural_fields import ColorSiren, MultiscaleSDF, Siren, TextureField, solve_sphere

PATIENCE = 60.0
TITLE = "<img src=x onerror=alert(1)> & ball"


def bumpy(*, gain=0.5):
    """A sphere of level 0 and bumps of two levels in its bands: no bump is larger than its band, unless ``gain`` is."""
    torch.manual_seed(3)
    base = Siren(32, 2, omega=6.0)
    solve_sphere(base, 0.6)
    residuals = [Siren(18, 2, omega=8.0, output_gain=gain), Siren(16, 3, omega=16.0, output_gain=0.1)]
    return MultiscaleSDF(base, residuals, [0.12, 0.05], taper=0.3).requires_grad_(False)


def painted():
    """Colours in a band that holds most of the coarsest level's surface, but not all."""
    torch.manual_seed(4)
    return TextureField(bumpy(), ColorSiren(16, 2, omega=8.0), delta=0.02, outside=(1.0, 0.0, 0.0)).requires_grad_(
        False
    )


def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)
    return found
