import subprocess
import sys

import pytest
import torch
from mplicits.neural_fields import InputError
from mplicits.neural_fields.backend.kernels.switch import choose, mode


def test_nothing_is_said_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MPLICITS_KERNELS", raising=False)
    assert mode() == "auto"
    assert "cpu" in choose(torch.zeros(2, 3), width=128, depth=2).reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"dtype": torch.float64}, "float64"),
        ({"features": 3}, "features"),
        ({"width": 1000}, "width 512"),
        ({"depth": 9}, "depth 8"),
    ],
)
def test_what_the_kernels_cannot_do(place: torch.device, changes: dict, reason: str) -> None:
    options = {"width": 128, "depth": 2} | changes
    x = torch.zeros(2, 3, dtype=options.pop("dtype", torch.float32), device=place)
    choice = choose(x, **options)
    assert not choice.fused
    assert reason in choice.reason


def test_other_modes(place: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.zeros(2, 3, device=place)
    assert choose(x, width=128, depth=2) == (True, "")
    monkeypatch.setenv("MPLICITS_KERNELS", "off")
    assert choose(x, width=128, depth=2) == (False, "MPLICITS_KERNELS=off")
    monkeypatch.setenv("MPLICITS_KERNELS", "fast")
    with pytest.raises(InputError, match="MPLICITS_KERNELS='fast'"):
        mode()


def test_triton_is_not_loaded_before_it_is_used() -> None:
    code = (
        "import sys, torch, mplicits.neural_fields as nf\n"
        "nf.MultiscaleSDF.from_widths([(8, 1), (8, 1)], omegas=[5, 5]).jet(torch.zeros(3, 3))\n"
        "assert 'triton' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")
