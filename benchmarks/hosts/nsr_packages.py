"""What instant-nsr-pl imports and no CPU has: tiny-cuda-nn, nerfacc 0.3.3 and Lightning, as far as it uses them.

`install` puts modules of these names where ``import`` looks: exact, slow, and in plain PyTorch.
"""

import contextlib
import enum
import math
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from unittest import mock

import numpy as np
import torch
from mplicits.neural_fields.networks.grids import HashEncoding
from torch import Tensor, nn

WARM_UP, UPDATE_EVERY, DECAY = 256, 16, 0.95  # of the occupancy grid, as in nerfacc


class HashGrid(HashEncoding):
    """Features at points of the unit cube (Müller et al. 2022)."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        levels, coarsest = config["n_levels"], config["base_resolution"]
        super().__init__(
            levels=levels,
            table_size=1 << config["log2_hashmap_size"],
            features=config["n_features_per_level"],
            coarsest=coarsest,
            finest=round(coarsest * config["per_level_scale"] ** (levels - 1)),
        )
        self.n_input_dims, self.n_output_dims = 3, self.size

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(N, C)`` of points ``(N, 3)`` of the unit cube."""
        return super().forward(2 * x - 1)


class SphericalHarmonics(nn.Module):
    """The sixteen real spherical harmonics of degrees 0 to 3, of directions given in the unit cube."""

    n_input_dims, n_output_dims = 3, 16

    def forward(self, directions: Tensor) -> Tensor:
        """Values ``(N, 16)`` at directions ``(N, 3)``."""
        x, y, z = (2 * directions - 1).unbind(-1)
        one = torch.ones_like(x)
        rows = (
            *((1 / 4, one), (3 / 4, x), (3 / 4, y), (3 / 4, z)),
            *((15 / 4, x * y), (15 / 4, y * z), (5 / 16, 3 * z * z - 1), (15 / 4, x * z), (15 / 16, x * x - y * y)),
            *((35 / 32, y * (3 * x * x - y * y)), (105 / 4, x * y * z), (21 / 32, y * (5 * z * z - 1))),
            *((7 / 16, z * (5 * z * z - 3)), (21 / 32, x * (5 * z * z - 1)), (105 / 16, z * (x * x - y * y))),
            (35 / 32, x * (x * x - 3 * y * y)),
        )
        return torch.stack([math.sqrt(square / math.pi) * term for square, term in rows], dim=-1)


def encoding(_dims: int, config: Mapping[str, Any]) -> nn.Module:
    """The encoding that tiny-cuda-nn would make of a configuration."""
    return {"HashGrid": lambda: HashGrid(config), "SphericalHarmonics": SphericalHarmonics}[config["otype"]]()


class ContractionType(enum.Enum):
    """nerfacc's; only boxes are served."""

    AABB = 0
    UN_BOUNDED_SPHERE = 2


class OccupancyGrid(nn.Module):
    """nerfacc's grid over a box: which cells a ray need not sample."""

    occupied: Tensor
    binary: Tensor

    def __init__(self, roi_aabb: Tensor, resolution: int, contraction_type: ContractionType) -> None:
        super().__init__()
        assert contraction_type is ContractionType.AABB
        self.resolution, (self.low, self.high) = resolution, roi_aabb.view(2, 3)
        self.register_buffer("occupied", torch.zeros(resolution**3))
        self.register_buffer("binary", torch.ones(resolution**3, dtype=torch.bool))

    @torch.no_grad()
    def every_n_step(self, step: int, occ_eval_fn: Callable[[Tensor], Tensor], occ_thre: float) -> None:
        """Evaluate all cells while training warms up, later those in use and a quarter of the others."""
        if step % UPDATE_EVERY:
            return
        count = self.resolution**3
        cells = torch.arange(count)
        if step >= WARM_UP:
            cells = torch.cat((self.binary.nonzero()[:, 0], torch.randint(count, (count // 4,)))).unique()
        corner = torch.stack(
            (cells // self.resolution**2, cells // self.resolution % self.resolution, cells % self.resolution), dim=-1
        )
        x = self.low + (self.high - self.low) * (corner + torch.rand(len(cells), 3)) / self.resolution
        found = torch.cat([occ_eval_fn(part)[:, 0] for part in x.split(1 << 14)])
        self.occupied[cells] = torch.maximum(DECAY * self.occupied[cells], found)
        self.binary.copy_(self.occupied > self.occupied.mean().clamp(max=occ_thre))

    def __getitem__(self, x: Tensor) -> Tensor:
        cell = ((x - self.low) / (self.high - self.low) * self.resolution).long().clamp(0, self.resolution - 1)
        return self.binary[(cell[..., 0] * self.resolution + cell[..., 1]) * self.resolution + cell[..., 2]]


def ray_aabb_intersect(origins: Tensor, directions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box, ``(N,)`` each; leaving is not after entering for those that miss it."""
    first, second = ((corner - origins) / directions for corner in box.view(2, 3))
    near = torch.minimum(first, second).amax(dim=-1).clamp(min=0)
    return near, torch.maximum(first, second).amin(dim=-1)


def ray_marching(
    rays_o: Tensor,
    rays_d: Tensor,
    *,
    scene_aabb: Tensor,
    grid: OccupancyGrid | None,
    render_step_size: float,
    stratified: bool,
    **_unused: object,
) -> tuple[Tensor, Tensor, Tensor]:
    """Steps of one length through the box, in occupied cells alone: rays ``(n,)``, ends ``(n, 1)``."""
    near, far = ray_aabb_intersect(rays_o, rays_d, scene_aabb)
    steps = max(1, math.ceil(((far - near).amax() / render_step_size).item()))
    begin = near[:, None] + render_step_size * torch.arange(steps)
    if stratified:
        begin = begin + render_step_size * torch.rand(len(near), 1)
    middle = begin + render_step_size / 2
    kept = middle < far[:, None]
    if grid is not None:
        kept &= grid[rays_o[:, None] + middle[..., None] * rays_d[:, None]]
    rays, _ = kept.nonzero(as_tuple=True)
    return rays, begin[kept][:, None], begin[kept][:, None] + render_step_size


def render_weight_from_alpha(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Opacity times what the samples before it on its ray let through, ``(n, 1)``."""
    counts = torch.bincount(ray_indices, minlength=n_rays)
    place = torch.arange(len(ray_indices)) - (counts.cumsum(0) - counts)[ray_indices]
    clear = alphas.new_ones(n_rays, int(counts.max()) + 1)
    clear = clear.index_put((ray_indices, place + 1), 1 - alphas[:, 0])
    return alphas * clear.cumprod(dim=1)[ray_indices, place][:, None]


def accumulate_along_rays(weights: Tensor, ray_indices: Tensor, values: Tensor | None, n_rays: int) -> Tensor:
    """Sums of weights, or of weighted values, ``(n_rays, channels)``."""
    terms = weights if values is None else weights * values
    return terms.new_zeros(n_rays, terms.shape[-1]).index_add(0, ray_indices, terms)


def to_tensor(image: Any) -> Tensor:
    """torchvision's: a picture of bytes ``(H, W)`` or ``(H, W, C)`` → ``(C, H, W)`` from 0 to 1."""
    values = torch.from_numpy(np.array(image)).float() / 255
    return values[None] if values.ndim == 2 else values.permute(2, 0, 1)


class LightningModule(nn.Module):
    """Lightning's, as far as one hand-written loop needs it."""

    global_step, current_epoch, trainer = 0, 0, None

    def log(self, name: str, value: object, **_settings: object) -> None:
        """Lightning's loggers are not read here."""


def install() -> None:
    """Let ``import`` find all this under the names that the host asks for."""

    def refuse(*_: object, **__: object) -> None:
        raise NotImplementedError("asked for what no loss of neus-dtu-wmask.yaml needs")

    names = {
        "tinycudann": {"Encoding": encoding, "Network": refuse, "free_temporary_memory": lambda: None},
        "nerfacc": {
            "ContractionType": ContractionType,
            "OccupancyGrid": OccupancyGrid,
            "ray_marching": ray_marching,
            "render_weight_from_alpha": render_weight_from_alpha,
            "render_weight_from_density": refuse,
            "accumulate_along_rays": accumulate_along_rays,
        },
        "nerfacc.intersection": {"ray_aabb_intersect": ray_aabb_intersect},
        "torch_efficient_distloss": {"flatten_eff_distloss": refuse},
        "torchvision": {},
        "torchvision.transforms": {},
        "torchvision.transforms.functional": {"to_tensor": to_tensor},
        "pytorch_lightning": {"LightningModule": LightningModule, "LightningDataModule": object},
        "pytorch_lightning.utilities": {},
        "pytorch_lightning.utilities.rank_zero": dict.fromkeys(("rank_zero_info", "rank_zero_debug"), lambda *_: None),
    }
    for name, contents in names.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        sys.modules[name] = module


@contextlib.contextmanager
def cpu_for_cuda() -> Iterator[None]:
    """``torch.cuda.device`` for hosts that say it where there is none."""
    with mock.patch.object(torch.cuda, "device", return_value=contextlib.nullcontext()):
        yield
