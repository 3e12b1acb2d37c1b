"""Wrong arguments are a ValueError that names the argument: one row each."""

import math
from collections.abc import Callable

import mplicits.neural_fields as nf
import pytest
import torch
from fields import FIELDS, SCREW, small_multiscale, small_spacetime
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields.fields.csg import Bounded, Placed
from mplicits.neural_fields.hosts.learning_rates import parameter_groups, rescale_parameters
from mplicits.neural_fields.networks.colors import ColorSiren
from mplicits.neural_fields.networks.encoded import EncodedField
from mplicits.neural_fields.networks.grids import HashEncoding, ValueGrid
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.neural_fields.shape import in_one_frame
from mplicits.neural_fields.spacetime.dynamic_tracing import DynamicTracer
from mplicits.neural_fields.spacetime.field import spacetime_jet
from mplicits.neural_fields.spacetime.flow import Solver, trajectories
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.spacetime.surface_velocity import CarriedVelocity
from mplicits.neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from mplicits.neural_fields.volume.render import Sampling

from benchmarks.motion.figures import ShrinkingSphere

BALL, NETWORK, FOUR = nf.Sphere(radius=0.5), nf.Siren(8, 1), FIELDS["moving"]()
EYE, AHEAD = torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])
POINTS, ROWS = torch.zeros(4, 3), torch.zeros(5, 3)
TEXTURE = nf.TextureField(BALL, ColorSiren(4, 1), delta=0.1)
VIEW = look_at((0.4, 0.5, 2.6), (0.0, 0.0, 0.0), fov=42.0, width=8, height=8).rays()

REFUSED: list[tuple[Callable[[], object], str]] = [
    # Solids
    (nf.Union, "expected at least one"),
    (lambda: nf.Difference(BALL, FOUR), r"parts of \[3, 4\] dimensions"),
    (lambda: nf.Union(BALL, smooth=-1.0), "smooth=-1.0"),
    (lambda: nf.Offset(BALL, math.nan), "by=nan"),
    (lambda: nf.Shell(BALL), "inside=0.0, outside=0.0"),
    (lambda: nf.Shell(BALL, inside=0.1, outside=-0.1), "outside=-0.1"),
    (lambda: Placed(FOUR, nf.Similarity.identity()), "in_dim=4"),
    (lambda: Bounded(FOUR), "in_dim=4"),
    (lambda: Bounded(BALL, radius=0.0), "radius=0.0"),
    (lambda: in_one_frame([]), "0 shapes"),
    (lambda: nf.FunctionField(lambda x: x.norm(dim=-1, keepdim=True)).value(POINTS), r"returned \(4, 1\)"),
    (lambda: nf.FunctionField(lambda x: 1.0).value(POINTS), "returned float"),
    (lambda: BALL.second_jet(POINTS, dims=4), "dims=4"),
    (lambda: nf.WorldField(small_spacetime()), "in_dim=4"),
    # Networks
    (lambda: nf.Siren(0, 2), "width=0"),
    (lambda: nf.Siren(8, 0), "depth=0"),
    (lambda: nf.Siren(8, 2, omega=-1.0), "omega=-1"),
    *(
        (lambda unit=unit: nf.Siren(8, 1).set_units(output=unit), f"output={unit}")
        for unit in (0.3, 0.0, -1.0, math.inf)
    ),
    (lambda: nf.MultiscaleSDF(BALL, [], [0.1]), "deltas has 1 entries"),
    (lambda: nf.MultiscaleSDF(BALL, [nf.Siren(4, 1)], [0.0]), r"deltas=\[0.0\]"),
    (lambda: nf.MultiscaleSDF(BALL, [nf.Siren(4, 1)], [0.1], taper=1.5), "taper=1.5"),
    (lambda: nf.MultiscaleSDF(BALL, [nf.Siren(4, 1, in_dim=4)], [0.1]), r"residuals\[0\].in_dim=4"),
    (lambda: nf.MultiscaleSDF.from_widths([(8, 1), (8, 1)], omegas=[30]), "omegas has 1 entries"),
    (lambda: nf.fit_sphere(nf.Siren(8, 1), 0.0), "radius=0.0"),
    (lambda: EncodedField(nf.Siren(8, 1, in_dim=4)), "in_dim=4"),
    (lambda: EncodedField(NETWORK, gain=0), "gain=0"),
    (lambda: HashEncoding(table_size=100), "table_size=100"),
    (lambda: HashEncoding(coarsest=32, finest=16), "coarsest=32"),
    (lambda: HashEncoding(levels=0), "levels=0"),
    (lambda: HashEncoding(features=0), "features=0"),
    (lambda: HashEncoding(extent=0), "extent=0"),
    (lambda: NeusSDF(30), "width=30"),
    (lambda: nf.ColorNetwork(-1), "num_features=-1"),
    (lambda: nf.ColorNetwork(1, width=0), "width=0"),
    (lambda: nf.ColorNetwork(1, depth=0), "depth=0"),
    (lambda: nf.ColorNetwork(4)(POINTS, POINTS, nf.Jet(POINTS[:, 0], POINTS, torch.zeros(4, 5))), "jet.features: 5"),
    (lambda: ValueGrid(0), "resolution=0"),
    (lambda: ValueGrid(8, reach=0.0), "reach=0.0"),
    (lambda: nf.TextureField(BALL, ColorSiren(4, 1), delta=0.0), "delta=0.0"),
    (lambda: nf.TextureField(BALL, ColorSiren(4, 1, in_dim=4), delta=0.1), "network: of 4 dimensions"),
    (lambda: nf.TextureField(BALL, ColorSiren(4, 1), delta=0.1, outside=(0, 0, 2)), "outside="),
    (lambda: nf.TextureField(BALL, ColorSiren(4, 1), delta=0.1, geometry_level=3), "level=3"),
    (lambda: TEXTURE.colors(torch.zeros(5, 4)), "x has shape"),
    (lambda: TEXTURE.value(ROWS, level=1), "level=1"),
    # What moves
    (lambda: nf.SpaceTimeSDF(small_multiscale()), "in_dim=3"),
    (lambda: nf.TimeSlice(BALL, 0.5), "in_dim=3"),
    (lambda: nf.TimeSlice(small_spacetime(), torch.rand(2)), r"t has shape \(2,\)"),
    (lambda: nf.SpaceTimeSDF.from_static(BALL), "a level of the field is a Sphere"),
    (lambda: nf.SpaceTimeSDF.from_static(small_spacetime()), "in_dim=4"),
    (lambda: spacetime_jet(small_spacetime(), torch.rand(2, 4), order=3), "order=3"),
    (lambda: Keyframes([0.0, 0.0], [BALL, BALL]), r"times=\[0.0, 0.0\]"),
    (lambda: Keyframes([0.0], []), "1 times for 0 fields"),
    (lambda: Keyframes([0.0], [small_spacetime()]), r"fields\[0\].in_dim=4"),
    (lambda: nf.Moving(small_spacetime(), SCREW), "in_dim=4"),
    (lambda: nf.RigidMotion(axis=(0.0, 0.0, 0.0)), "axis="),
    (lambda: ShrinkingSphere(radius=0.5, alpha=0.1), "radius=0.5, alpha=0.1"),
    (lambda: CarriedKeyframes(Keyframes([0.0], [BALL]), VelocitySiren(), steps=0), "steps=0"),
    (lambda: CarriedVelocity(ShrinkingSphere(), nodes=1), "nodes=1"),
    (lambda: CarriedVelocity(BALL), "in_dim=3"),
    (lambda: Solver(method="magic"), "method='magic'"),
    (lambda: Solver(rtol=0.0), "rtol=0.0"),
    (lambda: Solver(min_step=-1.0), "min_step=-1.0"),
    (lambda: nf.flow(SCREW.velocity, EYE, 0.0, 1.0), r"points has shape \(3,\)"),
    (lambda: nf.flow(SCREW.velocity, POINTS, torch.zeros(2), 1.0), r"start has shape \(2,\)"),
    (lambda: trajectories(SCREW.velocity, POINTS, [0.0, 0.5, 0.2]), "times="),
    (lambda: trajectories(SCREW.velocity, POINTS, []), r"times=\[\]"),
    (lambda: DynamicTracer(BALL, *VIEW), "in_dim=3"),
    (lambda: DynamicTracer(FOUR, *VIEW, tolerance=0.0).trace(0.0), "tolerance=0"),
    (lambda: DynamicTracer(FOUR, *VIEW, reach=-1.0), "reach=-1"),
    # Consumers
    (lambda: nf.sphere_trace(BALL, torch.zeros(4), AHEAD), r"origins has shape \(4,\)"),
    (lambda: nf.sphere_trace(BALL, EYE, torch.zeros(5, 2)), r"directions has shape \(5, 2\)"),
    (lambda: nf.sphere_trace(BALL, EYE, AHEAD, tolerance=0.0), "tolerance=0.0"),
    (lambda: nf.sphere_trace(BALL, EYE, AHEAD, lipschitz=-1.0), "lipschitz=-1.0"),
    (lambda: nf.sphere_trace(BALL, EYE, AHEAD, level=3), "level=3"),
    (lambda: nf.sphere_trace(BALL, EYE, AHEAD, budget=(20, 5)), r"budget=\[20, 5\]"),
    (lambda: nf.sphere_trace(FOUR, EYE, AHEAD), "in_dim=4"),
    (lambda: nf.WorldField(BALL).trace(EYE.numpy(), AHEAD), "origins and directions"),
    (lambda: nf.WorldField(small_multiscale()).distance(POINTS, level=3), "level=3"),
    *((lambda x=x: nf.WorldField(BALL).distance(x), "points has shape") for x in (POINTS[:, :2], EYE[0], 1.0)),
    (lambda: nf.extract_mesh(BALL, level=1), "level=1"),
    (lambda: nf.extract_mesh(BALL, resolution=1), "resolution=1"),
    (lambda: nf.extract_mesh(BALL, bounds=((0, 0, 0), (1, 0, 1))), "bounds="),
    (lambda: nf.extract_mesh(BALL, lipschitz=0.0), "lipschitz=0.0"),
    (lambda: nf.extract_mesh(BALL, clearance=0.5), "clearance=0.5"),
    (lambda: nf.extract_mesh(BALL, batch=0), "batch=0"),
    (lambda: nf.extract_mesh(FOUR), "in_dim=4"),
    (lambda: nf.render_volume(BALL, lambda x, v, jet: x, EYE, AHEAD, inv_std=10.0), r"origins \(3,\)"),
    (
        lambda: nf.render_volume(BALL, lambda x, v, jet: x, POINTS, POINTS, inv_std=1.0, skip_share=1.5),
        "skip_share=1.5",
    ),
    *(
        (lambda name=name, number=number: Sampling(**{name: number}), name)
        for name, number in {"uniform": 1, "importance": -1, "rounds": 0, "sharpness": 0.0, "outside": 0}.items()
    ),
    # Hosts
    (lambda: nf.NeuSGeometry(BALL, scale=0), "scale=0"),
    (lambda: nf.NeuSGeometry(BALL, bounds=torch.zeros(2, 3)), "bounds="),
    (lambda: nf.NeuSGeometry(BALL).follow(1.0, least=0.0), "least=0"),
    (lambda: nf.InstantNSRGeometry(BALL, radius=-1), "radius=-1"),
    *((lambda function=function: function(NETWORK, 0), "lr=0") for function in (parameter_groups, rescale_parameters)),
    *((lambda pace=pace: rescale_parameters(NETWORK, pace=pace), "pace") for pace in (-1.0, (1.0, 0.0), ())),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[f"{n}-{words}" for n, (_, words) in enumerate(REFUSED)])
def test_a_wrong_argument_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
