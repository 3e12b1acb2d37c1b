"""What ``reconstruct`` learns: geometry, colour by direction, the surface's uncertainty, and what is behind."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..neural_fields import Field, Jet, MultiscaleSDF, Siren
from ..neural_fields.baselines import NeusSDF
from ..neural_fields.radiance import Outside, ViewColor
from ..neural_fields.sphere_start import fit_sphere
from ..neural_fields.volume_renderer import Rendered, Sampling, render_volume
from .run.settings import ReconstructConfig

__all__ = ["SceneModel", "build_scene"]

# s = exp(10 v): one learning rate serves this number and the networks (NeuS begins at v = 0.3, s = 20).
SHARPENING = 10.0
FIRST_VARIANCE = 0.3


class SceneModel(nn.Module):
    """Everything that a pixel's colour depends on, in unit-sphere coordinates.

    Args:
        geometry: f.
        color: colour of its surface.
        outside: what is outside the unit sphere; None if nothing is.
        background: ``(3,)`` behind everything.
    """

    def __init__(self, geometry: Field, color: ViewColor, outside: Outside | None, background: Tensor) -> None:
        super().__init__()
        self.geometry, self.color, self.outside = geometry, color, outside
        self.variance = nn.Parameter(torch.tensor(FIRST_VARIANCE))
        self.register_buffer("background", background)
        self.background: Tensor

    @property
    def inv_std(self) -> Tensor:
        """S of NeuS, a 0-d tensor."""
        return (SHARPENING * self.variance).exp().clamp(max=1e6)

    def widen(self, band: float, least: float) -> None:
        """Make all bands ``band`` / s wide, but at least ``least``: as wide as the surface is unsure."""
        if len(self.geometry.deltas):
            self.geometry.deltas.fill_(max(band / float(self.inv_std.detach()), least))

    def render(
        self,
        origins: Tensor,
        directions: Tensor,
        sampling: Sampling,
        *,
        cos_anneal: float = 1.0,
        level: int = -1,
        least_weight: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Rendered:
        """`render_volume` of this scene, with colours in half precision on a GPU."""

        def color(x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
            with torch.autocast(x.device.type, torch.bfloat16, enabled=x.device.type == "cuda"):
                return self.color(x, direction, jet).float()

        return render_volume(
            self.geometry,
            color,
            origins,
            directions,
            inv_std=self.inv_std,
            sampling=sampling,
            cos_anneal=cos_anneal,
            level=level,
            background=self.background,
            outside=self.outside,
            least_weight=least_weight,
            generator=generator,
        )


def build_scene(config: ReconstructConfig, *, has_masks: bool) -> SceneModel:
    """An untrained scene: a sphere of unknown colour."""
    background = config.background
    if background == "auto":
        background = "white" if has_masks else "outside"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        if config.geometry == "neus":
            geometry: Field = NeusSDF(radius=config.radius)
            features = 256
        else:
            features = config.features
            geometry = MultiscaleSDF.from_widths(
                list(zip(config.widths, config.depths, strict=True)),
                omegas=config.omegas,
                deltas=[config.radius] * (len(config.widths) - 1),
                taper=config.taper,
                num_features=features,
                residual_gain=0.01,
            )
            base = geometry.base
            assert isinstance(base, Siren)
            fit_sphere(base, config.radius)
        color = ViewColor(
            features,
            width=config.color_width,
            depth=config.color_depth,
            point_frequencies=config.color_frequencies,
        )
        outside = Outside() if background == "outside" else None
    return SceneModel(geometry, color, outside, torch.full((3,), float(background == "white")))
