"""Surfaces without ripples where photographs say nothing: normals should turn evenly where pixels are all alike."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from ....neural_fields import Field

__all__ = ["flatness", "normal_variation", "tangents", "unevenness"]

STEP = 0.03  # between the normals that are compared, in radii of the region
GOLDEN = math.pi * (3 - math.sqrt(5))  # the angle between directions that follow one another
ALIKE = 0.05  # how far display RGB differs among neighbouring pixels that count 1 / e
CREASE = 0.03  # the variation of normals that counts half: they turn by another 10° from step to step


def flatness(color: NDArray[np.float32], mask: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """How little a photograph shows at each of its pixels ``(H, W)``: exp(−g / 0.05), in (0, 1].

    g is how far a channel reaches among a pixel and its eight neighbours.

    Args:
        color: ``(H, W, 3)`` display RGB in [0, 1].
        mask: ``(H, W)`` what is object; its rim is an edge.
    """
    seen = color if mask is None else color * mask[..., None]
    around = np.ones((3, 3), np.uint8)
    reach = (cv2.dilate(seen, around) - cv2.erode(seen, around)).max(axis=2)
    return np.exp(-reach / ALIKE)


def tangents(normals: Tensor) -> Tensor:
    """A unit vector at right angles to each of the normals ``(B, 3)``, in directions that are spread evenly.

    From row to row it turns by the golden angle, so that any rows after one another have all directions, and no random
    numbers are needed where the rows come at random.
    """
    axis = torch.eye(3, dtype=normals.dtype, device=normals.device)[normals.abs().argmin(dim=1)]
    across = normalize(torch.linalg.cross(normals, axis), dim=1)
    angle = GOLDEN * torch.arange(len(normals), device=normals.device)[:, None].to(normals)
    return angle.cos() * across + angle.sin() * torch.linalg.cross(normals, across)


def normal_variation(field: Field, points: Tensor, tangent: Tensor, *, step: float = STEP, level: int = -1) -> Tensor:
    """How unevenly normals turn along a surface ``(B,)``: |P (n(x − h u) − 2 n(x) + n(x + h u))|².

    n = ∇f / |∇f|, u is a tangent, and P takes away the part along n(x), which is there wherever normals turn at all.
    What is left is 0 on planes, spheres and cylinders of any radius: not curvature costs, but its change (as of the
    minimum variation surfaces of Moreton and Séquin 1992). It is h⁴ |P d²n / du²|² to the leading order.

    Args:
        field: f.
        points: ``(B, 3)`` x, on the surface or near it.
        tangent: ``(B, 3)`` u, unit vectors.
        step: h.
        level: of the field.
    """
    along = step * tangent
    before, here, after = normalize(
        field.jet(torch.stack((points - along, points, points + along)), level=level).gradient, dim=-1
    )
    bent = before - 2 * here + after
    return (bent - (bent * here).sum(dim=1, keepdim=True) * here).square().sum(dim=1)


def unevenness(field: Field, points: Tensor, tangent: Tensor, *, step: float = STEP, level: int = -1) -> Tensor:
    """`normal_variation` v ``(B,)`` as it is taught: v / (1 + v / 0.03).

    Ripples count as they are. Creases and thin parts, at which normals turn right round within a step, count no more
    than 0.03, and hardly less if they were a little blunter: nobody gains by rounding them off.
    """
    varied = normal_variation(field, points, tangent, step=step, level=level)
    return varied / (1 + varied / CREASE)
