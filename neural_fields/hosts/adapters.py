"""Fields with the interfaces of other renderers: NeuS, instant-nsr-pl, nerfstudio and sdfstudio.

Each evaluates a `Field` f in the host's units: f(s x) / s is again a distance. No host is imported; see
docs/drop-in.md.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ..backend.errors import positive
from ..fields.field import FieldLike
from ..volume.weights import neus_alpha
from ._hosted import Box, Hosted, joined
from .learning_rates import HOST_RATE, Pace


class NeuSGeometry(Hosted):
    """NeuS's ``SDFNetwork`` (Wang et al. 2021, ``models/fields.py``) around any field.

    NeuS's renderer calls ``forward`` and then ``gradient`` on the same tensor of points; both come from one jet
    (`PointMemo`).

    Args:
        field: signed distance, negative inside; with F features for a colour network that takes F.
        scale: NeuS's argument: points are multiplied by it, distances divided. By default 1, or with ``bounds`` what
            brings their farthest corner onto the field's unit sphere.
        bounds: box of the mesh, ``(2, 3)``; from -1.01 to 1.01 by default, as in NeuS.
        learning_rate: NeuS's one rate for all networks; the parameters of the field are then kept in units in which it
            suits them (`rescale_parameters`). None leaves them alone.
        pace: share of the rates that suit the field, one for all levels or one for each; see `Pace`.

    Raises:
        ValueError: a number is not positive, or the bounds are not a box.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import MultiscaleSDF, NeuSGeometry
        >>> network = NeuSGeometry(MultiscaleSDF.from_widths([(128, 4), (256, 5)], omegas=[30, 45], num_features=64))
        >>> points = torch.zeros(10, 3)
        >>> network(points).shape, network.gradient(points).shape
        (torch.Size([10, 65]), torch.Size([10, 1, 3]))
    """

    def __init__(
        self,
        field: FieldLike,
        *,
        scale: float | None = None,
        bounds: Box | None = None,
        learning_rate: float | None = None,
        pace: Pace = 1.0,
    ) -> None:
        super().__init__(field, scale=scale, bounds=bounds, half=1.01, learning_rate=learning_rate, pace=pace)

    def forward(self, x: Tensor) -> Tensor:
        """Distance and features at ``x`` ``(N, 3)`` → ``(N, 1 + F)``; without a graph they cost a value only."""
        return self._features(x)

    def sdf_hidden_appearance(self, x: Tensor) -> Tensor:
        """``forward`` under NeuS's other name."""
        return self(x)

    def sdf(self, x: Tensor) -> Tensor:
        """Distance at ``x`` ``(N, 3)`` → ``(N, 1)``; costs a value only."""
        return self._value(x)[..., None]

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient at ``x`` ``(N, 3)`` → ``(N, 1, 3)``, with its graph; like NeuS, leaves ``x`` requiring gradients."""
        return self._gradient(x)

    def _halves(self, x: Tensor) -> tuple[Tensor, Tensor]:
        output, gradient = super()._halves(x)
        return output, gradient.unsqueeze(-2)


class InstantNSRGeometry(Hosted):
    """instant-nsr-pl's ``VolumeSDF`` (``models/geometry.py``) around any field.

    Args:
        field: signed distance in the unit sphere, negative inside, with F = ``feature_dim`` − 1 features.
        radius: the host's ``radius``: points reach from −radius to radius on each axis.
        scale: points are multiplied by it, distances divided; 1 / radius by default, which leaves the corners of the
            host's cube outside the field's unit sphere; 1 / (√3 radius) takes them in.
        resolution: cells along each axis of the mesh of ``isosurface``.
        learning_rate: of the host's group ``geometry``; see `NeuSGeometry`.
        pace: see `NeuSGeometry`.

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
        self,
        field: FieldLike,
        *,
        radius: float = 1.0,
        scale: float | None = None,
        resolution: int = 512,
        learning_rate: float | None = None,
        pace: Pace = 1.0,
    ) -> None:
        positive(radius=radius)
        scale = 1 / radius if scale is None else scale
        super().__init__(field, scale=scale, bounds=None, half=radius, learning_rate=learning_rate, pace=pace)
        self.radius, self.resolution = float(radius), resolution

    def forward(
        self,
        points: Tensor,
        with_grad: bool = True,
        with_feature: bool = True,
        with_laplace: bool = False,
        camera_indices: object = None,
        ray_indices: object = None,
    ) -> Tensor | list[Tensor]:
        """``sdf`` ``(...,)`` and the outputs of the flags, in their order: a list, or the tensor itself if it is alone.

        A graph is recorded while training, as in the host, and only where gradients are enabled.

        Args:
            points: ``(..., 3)`` in the host's units.
            with_grad: add the gradient ``(..., 3)``.
            with_feature: add the feature ``(..., 1 + F)``, whose channel 0 is the distance.
            with_laplace: add the Laplacian ``(...,)``, from exact second derivatives; the host has finite differences.
            camera_indices: unused; the host passes it for its appearance embedding.
            ray_indices: unused, likewise.
        """
        with torch.set_grad_enabled(self.training and torch.is_grad_enabled()):
            if not (with_grad or with_feature or with_laplace):
                return self._value(points)
            if not (with_grad or with_laplace):
                feature = self._value_features(points)
                return [feature[..., 0], feature]
            if with_laplace:
                jet, *laplacian = self._second_jet(points)
            else:
                jet, laplacian = self._jet(points), []
            gradient = [jet.gradient] if with_grad else []
            feature = [joined(jet)] if with_feature else []
            return [jet.value, *gradient, *feature, *laplacian]

    def forward_level(self, points: Tensor) -> Tensor:
        """Distance ``(...,)`` at ``points`` ``(..., 3)``, for the host's marching cubes; a value only."""
        return self._value(points)

    @torch.no_grad()
    def isosurface(self) -> dict[str, Tensor]:
        """The mesh in the host's form: ``v_pos`` ``(V, 3)`` and ``t_pos_idx`` ``(T, 3)``."""
        mesh = self.mesh(self.resolution, normals=False)
        vertices = torch.as_tensor(mesh.vertices, dtype=torch.float32)
        return {"v_pos": vertices, "t_pos_idx": torch.as_tensor(mesh.faces, dtype=torch.int64)}

    def update_step(self, epoch: int, global_step: int) -> None:
        """Called by the host before every step; does nothing, see ``follow``."""

    def regularizations(self, out: object) -> dict[str, Tensor]:
        """Extra losses for the host: none."""
        return {}


class Deviation(nn.Module):
    """The sharpness of the surface as one parameter v: s = exp(10 v), NeuS's inverse standard deviation."""

    def __init__(self, initial: float = 0.3) -> None:
        super().__init__()
        self.variance = nn.Parameter(torch.full((1,), float(initial)))

    def get_variance(self) -> Tensor:
        """s, ``(1,)``, clamped to [1e-6, 1e6] as in the hosts."""
        return (10 * self.variance).exp().clamp(1e-6, 1e6)

    def forward(self, x: Tensor) -> Tensor:
        """The same s for each row of ``x`` → ``(len(x), 1)``."""
        return self.get_variance().expand(len(x), 1)


class NerfstudioField(Hosted):
    """nerfstudio's and sdfstudio's ``SDFField`` (``nerfstudio/fields/sdf_field.py``) for their NeuS models.

    Args:
        field: signed distance, negative inside.
        color: called as ``color(x, direction, jet)`` with ``(..., 3)``, ``(..., 3)`` and the field's `Jet` there, in
            the host's units; returns RGB ``(..., 3)``. `ColorNetwork` is one.
        heads: the host's ``FieldHeadNames``, whose members are the keys of the outputs.
        scale: points are multiplied by it, distances divided. By default 1, or with ``bounds`` what brings their
            farthest corner onto the field's unit sphere.
        bounds: the host's ``scene_box.aabb`` ``(2, 3)``, box of the mesh too; from -1 to 1 by default.
        deviation: initial v of the deviation network, the host's ``beta_init``; 0.3, that is s = 20, in NeuS.
        learning_rate: of the host's group ``fields``; see `NeuSGeometry`. Only the geometry changes units.
        pace: see `NeuSGeometry`.

    Raises:
        ValueError: a number is not positive, or the bounds are not a box.
    """

    def __init__(
        self,
        field: FieldLike,
        color: nn.Module,
        *,
        heads: Any,
        scale: float | None = None,
        bounds: Box | None = None,
        deviation: float = 0.3,
        learning_rate: float | None = None,
        pace: Pace = 1.0,
    ) -> None:
        super().__init__(field, scale=scale, bounds=bounds, half=1.0, learning_rate=learning_rate, pace=pace)
        self.color, self.heads = color, heads
        self.deviation_network = Deviation(deviation)
        self.cos_anneal_ratio = 1.0

    def set_cos_anneal_ratio(self, anneal: float) -> None:
        """Set ``cos_anneal`` of `neus_optical_depth`: 0 at the start of training, 1 after annealing."""
        self.cos_anneal_ratio = float(anneal)

    def forward_geonetwork(self, inputs: Tensor) -> Tensor:
        """Distance and features at ``inputs`` ``(..., 3)`` → ``(..., 1 + F)``; without a graph a value only."""
        return self._features(inputs)

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient at ``x`` ``(..., 3)`` → ``(..., 3)``, with its graph; free after `forward_geonetwork`."""
        return self._gradient(x)

    def get_sdf(self, ray_samples: Any) -> Tensor:
        """Distance at the starts of the samples ``(R, S)`` → ``(R, S, 1)``; costs a value only."""
        return self._value(ray_samples.frustums.get_start_positions())[..., None]

    def get_alpha(self, ray_samples: Any, sdf: Tensor | None = None, gradients: Tensor | None = None) -> Tensor:
        """Opacity of the host's samples ``(R, S)`` → ``(R, S, 1)``.

        Without ``sdf`` ``(R, S, 1)`` or ``gradients`` ``(R, S, 3)`` both come from one jet.
        """
        if sdf is None or gradients is None:
            jet = self._jet(ray_samples.frustums.get_start_positions())
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
        """Colour, distance, normal, gradient and, if asked, opacity of the samples ``(R, S)``, by the host's names."""
        frustums = ray_samples.frustums
        points = frustums.get_start_positions()
        jet = self._jet(points)
        sdf, heads = jet.value[..., None], self.heads
        outputs = {
            heads.RGB: self.color(points, frustums.directions, jet),
            heads.SDF: sdf,
            # Of nerfstudio, and of sdfstudio.
            heads.NORMALS if hasattr(heads, "NORMALS") else heads.NORMAL: nn.functional.normalize(jet.gradient, dim=-1),
            heads.GRADIENT: jet.gradient,
        }
        if return_alphas:
            outputs[heads.ALPHA] = self.get_alpha(ray_samples, sdf, jet.gradient)
        return outputs

    def forward(
        self, ray_samples: Any, compute_normals: bool = False, return_alphas: bool = False
    ) -> dict[Any, Tensor]:
        """See `get_outputs`; normals are always among the outputs."""
        return self.get_outputs(ray_samples, return_alphas=return_alphas)

    def frontal_colors(self, x: Tensor) -> Tensor:
        """Colours ``(..., 3)`` of surface points ``(..., 3)``, each seen against its normal."""
        jet = self._jet(x)
        return self.color(x, -nn.functional.normalize(jet.gradient, dim=-1), jet)

    def follow(self, inv_s: Tensor | float | None = None, **widths: float) -> None:
        """See `Hosted.follow`; the deviation is this field's own by default."""
        super().follow(self.deviation_network.get_variance() if inv_s is None else inv_s, **widths)

    def parameter_groups(self, lr: float = HOST_RATE) -> list[dict[str, Any]]:
        """See `Hosted.parameter_groups`; colours and deviation have ``lr`` itself."""
        others = [*self.color.parameters(), *self.deviation_network.parameters()]
        return [*super().parameter_groups(lr), {"params": others, "lr": lr}]
