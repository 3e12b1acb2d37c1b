"""One row of ``mplicits bench reconstruct``: what a geometry cost on a scene, and how near it came."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["EQUAL_TIME", "MULTISCALE", "NEUS", "ReconstructRow", "SurfaceFigures"]

NEUS = "neus"
MULTISCALE = "multiscale"
EQUAL_TIME = "equal-time"


@dataclass(frozen=True)
class SurfaceFigures:
    """A reconstructed surface against the exact one; see `evaluate.Metrics`.

    Attributes:
        chamfer: squared L2, both ways, in units of the exact surface's bounding sphere.
        floor: what the exact surface itself would score.
        largest_chamfer: of the component of largest area alone.
        iou: of the volumes, or None.
        normal_consistency: mean |n·n'|, or None.
        components: connected ones.
    """

    chamfer: float
    floor: float | None
    largest_chamfer: float
    iou: float | None
    normal_consistency: float | None
    components: int


@dataclass(frozen=True)
class ReconstructRow:
    """One geometry, trained on one scene.

    FLOPs are those of the matrix products of training; how they are counted is said in `bench_reconstruct_train`.

    Attributes:
        scene: name of the scene or data set.
        kind: NEUS or MULTISCALE, both with as many steps, or EQUAL_TIME: multiscale for as long as NEUS took.
        network: widths and depths of the geometry.
        steps: training steps.
        rays: per step.
        seconds: of all steps.
        start_seconds: before the first step: making the geometry a sphere.
        step_seconds: median of the steps.
        views: held-out views that were measured.
        psnr: mean over these views, in dB.
        psnr_object: the same inside the masks; None without masks.
        ssim: mean over these views.
        parameters: of the geometry.
        color_parameters: of the colour network.
        outside_parameters: of what is behind the object, 0 if nothing is.
        geometry_flops: per ray.
        color_flops: per ray, of the colours and of what is behind the object.
        values_per_ray: evaluations of each level without gradient, to find out where to sample.
        jets_per_ray: evaluations of each level with gradient, which are trained.
        colors_per_ray: evaluations of the colour network.
        finest_share: of the samples on a ray, how many the finest level saw while it was switched on; None if it never
            was.
        exact: whether the scene's surface is known in closed form.
        surface: None where it is not, or where the training found no surface.
        inv_std: s of NeuS at the end.
        deltas: half-widths of the bands at the end.
        device: where it was trained.
    """

    scene: str
    kind: str
    network: str
    steps: int
    rays: int
    seconds: float
    start_seconds: float
    step_seconds: float
    views: int
    psnr: float
    psnr_object: float | None
    ssim: float
    parameters: int
    color_parameters: int
    outside_parameters: int
    geometry_flops: float
    color_flops: float
    values_per_ray: tuple[float, ...]
    jets_per_ray: tuple[float, ...]
    colors_per_ray: float
    finest_share: float | None
    exact: bool
    surface: SurfaceFigures | None
    inv_std: float
    deltas: tuple[float, ...]
    device: str

    @property
    def flops_per_ray(self) -> float:
        """Of all networks."""
        return self.geometry_flops + self.color_flops

    @property
    def rate(self) -> float:
        """FLOP/s that the training reached."""
        return self.flops_per_ray * self.rays * self.steps / self.seconds

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self) | {"flops_per_ray": self.flops_per_ray, "flops_per_second": self.rate}

    @classmethod
    def from_dict(cls, figures: Mapping[str, Any]) -> ReconstructRow:
        """The row that `as_dict` wrote.

        Raises:
            KeyError: a figure is missing.
            TypeError: a figure is of another kind.
        """
        known = {name: figures[name] for name in cls.__dataclass_fields__}
        for name in ("values_per_ray", "jets_per_ray", "deltas"):
            known[name] = tuple(known[name])
        if known["surface"] is not None:
            known["surface"] = SurfaceFigures(**known["surface"])
        return cls(**known)
