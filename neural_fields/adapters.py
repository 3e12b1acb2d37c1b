"""Fields in the shapes that other people's renderers call: NeuS, instant-nsr-pl, nerfstudio and sdfstudio.

Each shell holds a `Field` f and evaluates it in the host's own units: with ``scale`` s, points are multiplied by s and
distances divided by it, so that f(s x) / s is again a distance and its gradient is ∇f(s x). None of the hosts is
imported; what they pass in is used by the names of its attributes. How to change each host is in docs/drop-in.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from ._checks import positive
from ._point_memo import PointMemo
from .field import Field, Jet
from .function import FieldLike, as_field
from .meshing import extract_mesh
from .volume import neus_alpha

__all__ = ["Deviation", "InstantNSRGeometry", "NerfstudioField", "NeuSGeometry"]


class NeuSGeometry(nn.Module):
    """NeuS's ``SDFNetwork`` (Wang et al. 2021, ``models/fields.py``) around any field.

    NeuS's renderer calls ``forward`` and then ``gradient`` on the same tensor of points. Both come from one jet: the
    second call is served from what the first one evaluated (see `PointMemo`).

    Args:
        field: signed distance, negative inside; with F features for a colour network that takes F.
        scale: NeuS's own argument: points are multiplied by it, distances divided by it.

    Raises:
        ValueError: the scale is not positive.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import MultiscaleSDF, NeuSGeometry
        >>> network = NeuSGeometry(MultiscaleSDF.from_widths([(128, 4), (256, 5)], omegas=[30, 45], num_features=64))
        >>> points = torch.zeros(10, 3)
        >>> network(points).shape, network.gradient(points).shape
        (torch.Size([10, 65]), torch.Size([10, 1, 3]))
    """

    def __init__(self, field: FieldLike, *, scale: float = 1.0) -> None:
        super().__init__()
        positive(scale=scale)
        self.field, self.scale = as_field(field), float(scale)
        self._memo = PointMemo()

    def forward(self, x: Tensor) -> Tensor:
        """Distance and features at ``x`` ``(N, 3)`` → ``(N, 1 + F)``."""
        return self._memo.ask("value", x, self.field, lambda: self._evaluate(x))

    def sdf_hidden_appearance(self, x: Tensor) -> Tensor:
        """The same as ``forward``, under the other name that NeuS gives it."""
        return self(x)

    def sdf(self, x: Tensor) -> Tensor:
        """Distance at ``x`` ``(N, 3)`` → ``(N, 1)``; costs a value only."""
        return _value(self.field, x, self.scale)[..., None]

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient at ``x`` ``(N, 3)`` → ``(N, 1, 3)``, with its graph; like NeuS, leaves ``x`` requiring gradients."""
        gradient = self._memo.ask("gradient", x, self.field, lambda: self._evaluate(x))
        return _mark(x, gradient)

    def _evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        jet = _jet(self.field, x, self.scale)
        return _joined(jet), jet.gradient.unsqueeze(-2)


class InstantNSRGeometry(nn.Module):
    """instant-nsr-pl's ``VolumeSDF`` (``models/geometry.py``) around any field.

    Args:
        field: signed distance in the unit sphere, negative inside, with F = ``feature_dim`` − 1 features.
        radius: the host's ``radius``: points reach from −radius to radius on each axis.
        scale: points are multiplied by it, distances divided by it; 1 / radius by default, which leaves the corners
            of the host's cube outside the field's unit sphere; 1 / (√3 radius) takes them in.
        resolution: cells along each axis of the mesh that ``isosurface`` extracts.

    Raises:
        ValueError: a number is not positive.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import InstantNSRGeometry, Sphere
        >>> geometry = InstantNSRGeometry(Sphere(radius=0.5), radius=1.5)
        >>> sdf, gradient, feature = geometry(torch.tensor([[1.5, 0.0, 0.0]]))
        >>> sdf.tolist(), gradient.tolist(), feature.tolist()
        ([0.75], [[1.0, 0.0, 0.0]], [[0.75]])
    """

    def __init__(
        self, field: FieldLike, *, radius: float = 1.0, scale: float | None = None, resolution: int = 512
    ) -> None:
        super().__init__()
        positive(radius=radius)
        scale = 1 / radius if scale is None else scale
        positive(scale=scale)
        self.field, self.radius, self.scale, self.resolution = as_field(field), float(radius), float(scale), resolution

    def forward(
        self,
        points: Tensor,
        with_grad: bool = True,
        with_feature: bool = True,
        with_laplace: bool = False,
        camera_indices: object = None,
        ray_indices: object = None,
    ) -> Tensor | list[Tensor]:
        """What the flags ask for, in this order; a list, or the tensor itself if it is alone.

        Args:
            points: ``(..., 3)`` in the host's units.
            with_grad: the gradient too, ``(..., 3)``.
            with_feature: the feature too, ``(..., 1 + F)``; its channel 0 is the distance.
            with_laplace: the Laplacian too, ``(...,)``, from exact second derivatives; the host has finite differences.
            camera_indices: unused; the host passes it for its appearance embedding.
            ray_indices: unused, likewise.

        Returns:
            ``sdf`` ``(...,)``, alone or first in the list. Value and gradient come from one jet; the distance alone
            costs a value only. A graph is recorded while training, as the host does, and only where gradients
            are enabled.
        """
        with torch.set_grad_enabled(self.training and torch.is_grad_enabled()):
            if not (with_grad or with_feature or with_laplace):
                return _value(self.field, points, self.scale)
            if with_laplace:
                with _full_precision(points):
                    value, slope, features, hessian = self.field.second_jet(points * self.scale)
                jet = Jet(value / self.scale, slope, features)
                laplacian = [self.scale * hessian.diagonal(dim1=-2, dim2=-1).sum(dim=-1)]
            else:
                jet, laplacian = _jet(self.field, points, self.scale), []
            gradient = [jet.gradient] if with_grad else []
            feature = [_joined(jet)] if with_feature else []
            return [jet.value, *gradient, *feature, *laplacian]

    def forward_level(self, points: Tensor) -> Tensor:
        """Distance ``(...,)`` at ``points`` ``(..., 3)``, for the host's marching cubes; a value only."""
        return _value(self.field, points, self.scale)

    @torch.no_grad()
    def isosurface(self) -> dict[str, Tensor]:
        """The mesh, by `extract_mesh`, in the host's form: ``v_pos`` ``(V, 3)`` and ``t_pos_idx`` ``(T, 3)``."""
        reach = self.radius * self.scale
        bounds = ((-reach, -reach, -reach), (reach, reach, reach))
        mesh = extract_mesh(self.field, resolution=self.resolution, bounds=bounds, normals=False)
        vertices = torch.as_tensor(mesh.vertices, dtype=torch.float32) / self.scale
        return {"v_pos": vertices, "t_pos_idx": torch.as_tensor(mesh.faces, dtype=torch.int64)}

    def update_step(self, epoch: int, global_step: int) -> None:
        """Called by the host before every step; there is nothing to schedule."""

    def regularizations(self, out: object) -> dict[str, Tensor]:
        """Extra losses that the host adds: none."""
        return {}


class Deviation(nn.Module):
    """The one number that says how sharp the surface is: s = exp(10 v), NeuS's inverse standard deviation.

    Args:
        initial: v at the start; 0.3, that is s = 20, in NeuS.
    """

    def __init__(self, initial: float = 0.3) -> None:
        super().__init__()
        self.variance = nn.Parameter(torch.full((1,), float(initial)))

    def get_variance(self) -> Tensor:
        """s, ``(1,)``, kept between 1e-6 and 1e6 as the hosts do."""
        return (10 * self.variance).exp().clamp(1e-6, 1e6)

    def forward(self, x: Tensor) -> Tensor:
        """The same s for each row of ``x`` → ``(len(x), 1)``."""
        return self.get_variance().expand(len(x), 1)


class NerfstudioField(nn.Module):
    """nerfstudio's and sdfstudio's ``SDFField`` (``nerfstudio/fields/sdf_field.py``) for their NeuS models.

    Args:
        field: signed distance, negative inside.
        color: called as ``color(x, direction, jet)`` with ``(..., 3)``, ``(..., 3)`` and the field's `Jet` there, in
            the host's units; gives RGB ``(..., 3)``. `ViewColor` is one.
        heads: the host's ``FieldHeadNames``, whose members are the keys of the outputs.
        scale: points are multiplied by it, distances divided by it.
        deviation: initial value of the deviation network, the host's ``beta_init``.

    Raises:
        ValueError: the scale is not positive.
    """

    def __init__(
        self, field: FieldLike, color: nn.Module, *, heads: Any, scale: float = 1.0, deviation: float = 0.3
    ) -> None:
        super().__init__()
        positive(scale=scale)
        self.field, self.color, self.scale = as_field(field), color, float(scale)
        self.heads = heads
        self.deviation_network = Deviation(deviation)
        self.cos_anneal_ratio = 1.0
        self._memo = PointMemo()

    def set_cos_anneal_ratio(self, anneal: float) -> None:
        """How true the slope in the opacity is: 0 at the start of training, 1 at the end of the annealing."""
        self.cos_anneal_ratio = float(anneal)

    def forward_geonetwork(self, inputs: Tensor) -> Tensor:
        """Distance and features at ``inputs`` ``(..., 3)`` → ``(..., 1 + F)``."""
        return self._memo.ask("value", inputs, self.field, lambda: self._evaluate(inputs))

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient at ``x`` ``(..., 3)`` → ``(..., 3)``, with its graph; free after `forward_geonetwork`."""
        return _mark(x, self._memo.ask("gradient", x, self.field, lambda: self._evaluate(x)))

    def get_sdf(self, ray_samples: Any) -> Tensor:
        """Distance at the starts of the samples ``(R, S)`` → ``(R, S, 1)``; costs a value only."""
        return _value(self.field, ray_samples.frustums.get_start_positions(), self.scale)[..., None]

    def get_alpha(self, ray_samples: Any, sdf: Tensor | None = None, gradients: Tensor | None = None) -> Tensor:
        """Opacity of the samples ``(R, S)`` → ``(R, S, 1)``.

        Args:
            ray_samples: the host's samples, with ``frustums`` and ``deltas`` ``(R, S, 1)``.
            sdf: ``(R, S, 1)`` if known.
            gradients: ``(R, S, 3)`` if known; where one of the two is missing, both come from one jet.
        """
        if sdf is None or gradients is None:
            jet = _jet(self.field, ray_samples.frustums.get_start_positions(), self.scale)
            sdf, gradients = jet.value[..., None], jet.gradient
        return neus_alpha(
            sdf,
            (ray_samples.frustums.directions * gradients).sum(dim=-1, keepdim=True),
            ray_samples.deltas,
            self.deviation_network.get_variance(),
            cos_anneal=self.cos_anneal_ratio,
        )

    def get_outputs(
        self, ray_samples: Any, density_embedding: object = None, return_alphas: bool = False
    ) -> dict[Any, Tensor]:
        """Colour, distance, normal and gradient of the samples, and their opacity, under the host's names.

        Args:
            ray_samples: the host's samples ``(R, S)``.
            density_embedding: unused; the host's signature has it.
            return_alphas: whether the opacity is among the outputs.
        """
        frustums = ray_samples.frustums
        points = frustums.get_start_positions()
        jet = _jet(self.field, points, self.scale)
        sdf = jet.value[..., None]
        outputs = {
            self.heads.RGB: self.color(points, frustums.directions, jet),
            self.heads.SDF: sdf,
            self._normal_head(): nn.functional.normalize(jet.gradient, dim=-1),
            self.heads.GRADIENT: jet.gradient,
        }
        if return_alphas:
            outputs[self.heads.ALPHA] = self.get_alpha(ray_samples, sdf, jet.gradient)
        return outputs

    def forward(
        self, ray_samples: Any, compute_normals: bool = False, return_alphas: bool = False
    ) -> dict[Any, Tensor]:
        """See `get_outputs`; normals are always among the outputs."""
        return self.get_outputs(ray_samples, return_alphas=return_alphas)

    def _normal_head(self) -> Any:
        """What the host calls normals: NORMALS in nerfstudio, NORMAL in sdfstudio."""
        return self.heads.NORMALS if hasattr(self.heads, "NORMALS") else self.heads.NORMAL

    def _evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        jet = _jet(self.field, x, self.scale)
        return _joined(jet), jet.gradient


def _value(field: Field, x: Tensor, scale: float) -> Tensor:
    with _full_precision(x):
        return field.value(x * scale) / scale


def _jet(field: Field, x: Tensor, scale: float) -> Jet:
    """The jet of f(s x) / s, in a graph that reaches ``x``."""
    with _full_precision(x), _reaching(x) as reached:
        value, gradient, features = field.jet(reached * scale)
        return Jet(value / scale, gradient, features)


def _joined(jet: Jet) -> Tensor:
    """Distance and features in one tensor ``(..., 1 + F)``."""
    return torch.cat((jet.value[..., None], jet.features), dim=-1)


def _full_precision(x: Tensor) -> torch.autocast:
    """Hosts train in half precision, in which a distance near the surface has no digits left."""
    return torch.autocast(x.device.type, enabled=False)


@contextmanager
def _reaching(x: Tensor) -> Iterator[Tensor]:
    """``x`` for an evaluation whose graph reaches it, with its own flag as it was afterwards.

    The hosts evaluate first and mark the points as requiring gradients later, inside ``gradient``. Whoever then
    differentiates the gradient by the points (curvature) needs a graph that knew them. While the flag is
    off, autograd passes such points by.
    """
    if not torch.is_grad_enabled() or x.requires_grad:
        yield x
    elif x.is_inference():
        yield x.clone()  # autograd cannot save inference tensors
    else:
        x.requires_grad_(True)
        try:
            yield x
        finally:
            x.requires_grad_(False)


def _mark(x: Tensor, gradient: Tensor) -> Tensor:
    """Return ``gradient``, with ``x`` requiring gradients from now on."""
    if torch.is_grad_enabled() and not x.is_inference():
        x.requires_grad_(True)
    return gradient
