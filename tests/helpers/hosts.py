"""What the hosts of the adapters do with their geometry, in small: same calls, same order, same shapes."""

import enum
from dataclasses import dataclass

import torch
from mplicits.neural_fields import Field, NeuSGeometry
from torch import Tensor, nn
from torch.nn.functional import normalize, relu


def points(count: int = 50, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(count, 3, dtype=dtype) - 0.5


def rays(count: int = 6) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    origins = torch.tensor([0.0, 0.0, -1.0]) + 0.1 * torch.rand(count, 3)
    directions = normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.2 * torch.rand(count, 3), dim=-1)
    return origins, directions, torch.linspace(0.2, 1.8, 8).expand(count, 8), torch.rand(count, 3)


class Separate(nn.Module):
    """The same geometry as NeuS itself has it: every question is an evaluation of its own."""

    def __init__(self, field: Field) -> None:
        super().__init__()
        self.field = field

    def sdf(self, x: Tensor) -> Tensor:
        return self.field.value(x)[:, None]

    def forward(self, x: Tensor) -> Tensor:
        jet = self.field.jet(x)
        return torch.cat((jet.value[:, None], jet.features), -1)

    def gradient(self, x: Tensor) -> Tensor:
        x.requires_grad_(True)
        return self.field.jet(x).gradient[:, None]


class NeuSHost:
    def __init__(self, geometry: NeuSGeometry | Separate, features: int) -> None:
        self.geometry = geometry
        self.color = nn.Sequential(nn.Linear(9 + features, 16), nn.ReLU(), nn.Linear(16, 3), nn.Sigmoid())
        self.inverse_deviation = nn.Parameter(torch.tensor(0.3))

    def parameters(self) -> list[nn.Parameter]:
        return [*self.geometry.parameters(), *self.color.parameters(), self.inverse_deviation]

    def finer_depths(self, origins: Tensor, directions: Tensor, depths: Tensor) -> Tensor:
        """Up-sampling: the distance alone, without gradients, in rounds."""
        with torch.no_grad():
            for _ in range(2):
                x = origins[:, None, :] + directions[:, None, :] * depths[..., :, None]
                sdf = self.geometry.sdf(x.reshape(-1, 3)).reshape(depths.shape)
                nearest = depths.gather(1, sdf.abs().argmin(dim=1, keepdim=True))
                depths = torch.cat((depths, nearest + 0.01), -1).sort(dim=-1)[0]
        return depths

    def loss(self, origins: Tensor, directions: Tensor, depths: Tensor, wanted: Tensor) -> Tensor:
        rays, samples = depths.shape
        x = (origins[:, None, :] + directions[:, None, :] * depths[..., :, None]).reshape(-1, 3)
        toward = directions[:, None, :].expand(rays, samples, 3).reshape(-1, 3)
        output = self.geometry(x)
        sdf, feature = output[:, :1], output[:, 1:]
        gradients = self.geometry.gradient(x).squeeze()
        color = self.color(torch.cat((x, toward, gradients, feature), -1)).reshape(rays, samples, 3)
        slope = -relu(-(toward * gradients).sum(-1, keepdim=True))
        inverse = (10 * self.inverse_deviation).exp()
        ahead, behind = (torch.sigmoid((sdf + sign * slope * 0.05) * inverse) for sign in (-1, 1))
        alpha = ((ahead - behind + 1e-5) / (ahead + 1e-5)).reshape(rays, samples).clip(0, 1)
        passed = torch.cumprod(torch.cat((depths.new_ones(rays, 1), 1 - alpha + 1e-7), -1), -1)[:, :-1]
        rendered = (color * (alpha * passed)[..., None]).sum(dim=1)
        eikonal = ((gradients.reshape(rays, samples, 3).norm(dim=-1) - 1) ** 2).mean()
        return (rendered - wanted).abs().mean() + 0.1 * eikonal


Heads = enum.Enum("Heads", ["RGB", "SDF", "NORMALS", "GRADIENT", "ALPHA"])
OldHeads = enum.Enum("OldHeads", ["RGB", "SDF", "NORMAL", "GRADIENT", "ALPHA"])


@dataclass
class Frustums:
    """The part of nerfstudio's class that fields use."""

    origins: Tensor
    directions: Tensor
    starts: Tensor

    @property
    def shape(self) -> torch.Size:
        return self.origins.shape[:-1]

    def get_start_positions(self) -> Tensor:
        return self.origins + self.directions * self.starts


@dataclass
class RaySamples:
    frustums: Frustums
    deltas: Tensor
    camera_indices: Tensor


def ray_samples(depths: Tensor) -> RaySamples:
    origins, directions, _, _ = rays(len(depths))
    shape = (*depths.shape, 3)
    frustums = Frustums(origins[:, None].expand(shape), directions[:, None].expand(shape), depths[..., None])
    return RaySamples(frustums, torch.full((*depths.shape, 1), 0.2), torch.zeros(*depths.shape, 1, dtype=torch.long))
