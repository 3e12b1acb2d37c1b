"""All pixels of some pictures, and rays drawn from them at random."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..datasets.views.images import PosedImage
from ..neural_fields import InputError, Similarity
from ..neural_fields.volume import sphere_span

__all__ = ["RayPool", "Rays", "camera_rays"]


class Rays(NamedTuple):
    """Rays in unit-sphere coordinates, and what the pictures say about them.

    Attributes:
        origins: ``(R, 3)``.
        directions: ``(R, 3)`` unit vectors.
        color: ``(R, 3)`` display RGB in [0, 1].
        mask: ``(R,)`` how much of the pixel is object; 1 everywhere if nobody said.
    """

    origins: Tensor
    directions: Tensor
    color: Tensor
    mask: Tensor


def camera_rays(view: PosedImage, similarity: Similarity) -> tuple[Tensor, Tensor]:
    """Origins and unit directions, both ``(H · W, 3)`` float32, of a picture's pixels in unit-sphere coordinates."""
    eye, directions = view.camera.moved(similarity).rays()
    return eye.expand(directions.shape[:2].numel(), 3), directions.reshape(-1, 3)


class RayPool:
    """The pixels whose rays meet the unit sphere.

    Directions are worked out when rays are drawn, from the pixel's number: of all pixels only the colours are kept.

    Args:
        views: the pictures.
        similarity: from world to unit-sphere coordinates.
        device: where the rays are wanted.

    Raises:
        InputError: no ray of any picture meets the region of interest.
    """

    def __init__(self, views: Sequence[PosedImage], similarity: Similarity, device: torch.device) -> None:
        self.device, self.has_masks = device, all(view.mask is not None for view in views)
        cameras = [view.camera.moved(similarity) for view in views]
        self.eyes = torch.stack([camera.eye for camera in cameras]).float().to(device)
        self.axes = torch.stack([camera.world_from_camera[:3, :3] for camera in cameras]).float().to(device)
        lens = [camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras]
        self.lens = torch.stack(lens).float().to(device)  # (V, 4): fx, fy, cx, cy
        self.widths = torch.tensor([camera.width for camera in cameras], device=device)
        colors, masks, pixels, owners = [], [], [], []
        for index, view in enumerate(views):
            near, far = sphere_span(*camera_rays(view, similarity))
            kept = (far > near).nonzero()[:, 0]
            pixels.append(kept.int())
            owners.append(torch.full_like(kept, index, dtype=torch.int16))
            # Eight bits hold what pictures hold; a pool of float32 would be four times as large.
            colors.append(_bytes(view.color.reshape(-1, 3))[kept])
            if self.has_masks and view.mask is not None:
                masks.append(_bytes(view.mask.reshape(-1))[kept])
        self.colors, self.pixels = torch.cat(colors).to(device), torch.cat(pixels).to(device)
        self.owners = torch.cat(owners).to(device)
        self.masks = torch.cat(masks).to(device) if masks else None
        if not len(self.pixels):
            raise InputError("no pixel of any picture sees the region of interest; see `mplicits check-cameras`")

    def __len__(self) -> int:
        return len(self.pixels)

    def draw(self, count: int, generator: torch.Generator) -> Rays:
        """``count`` rays at random, with replacement."""
        rows = torch.randint(len(self), (count,), generator=generator).to(self.device)
        view, pixel = self.owners[rows].long(), self.pixels[rows].long()
        fx, fy, cx, cy = self.lens[view].unbind(dim=1)
        x, y = pixel % self.widths[view], pixel // self.widths[view]
        seen = torch.stack(((x - cx) / fx, (y - cy) / fy, torch.ones_like(fx)), dim=1)
        directions = torch.nn.functional.normalize(torch.einsum("rij,rj->ri", self.axes[view], seen), dim=1)
        mask = torch.ones(count, device=self.device) if self.masks is None else self.masks[rows] / 255
        return Rays(self.eyes[view], directions, self.colors[rows] / 255, mask)


def _bytes(numbers: np.ndarray) -> Tensor:
    return torch.from_numpy(np.rint(np.clip(numbers, 0, 1) * 255).astype(np.uint8))
