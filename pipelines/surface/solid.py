"""A closed mesh as a field: exact distances, so that it can be joined with fits, offset and traced."""

from __future__ import annotations

import torch
from torch import Tensor

from ...neural_fields import Jet, Mesh
from ...neural_fields.fields.field import OneLevelField
from .distance import MeshDistance
from .surface import is_closed, volume


class MeshField(OneLevelField):
    """The signed distance to a closed mesh, exact to rounding, in float64 on the CPU, without a graph.

    A mesh that is turned inside out is turned back. Raises a ValueError if it is not closed or encloses nothing.
    """

    def __init__(self, mesh: Mesh) -> None:
        super().__init__()
        if not is_closed(mesh):
            raise ValueError("mesh: is not closed, so that it has no inside")
        inside = volume(mesh)
        if inside == 0:
            raise ValueError("mesh: encloses nothing")
        faces = mesh.faces if inside > 0 else mesh.faces[:, ::-1]
        self.volume, self.distance = abs(inside), MeshDistance(Mesh(mesh.vertices, faces))

    def extra_repr(self) -> str:
        """How many triangles there are."""
        return f"faces={len(self.distance.corners)}"

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.jet(x, level=level).value

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the gradient leads away from the nearest point of the mesh."""
        self.resolve_level(level)
        rows = self.check_points(x).detach().reshape(-1, 3).cpu().double().numpy()
        value, slope = (torch.from_numpy(part).to(x) for part in self.distance.with_slope(rows, certain=False))
        return Jet(value.reshape(x.shape[:-1]), slope.reshape(x.shape), x.new_empty((*x.shape[:-1], 0)))
