"""The kernels compile for GPUs that are not here: Triton brings the whole compiler, which needs no device.

What the interpreter takes and the compiler does not, this finds.
"""

import json
import os
import subprocess
import sys

import pytest

# Shared memory that a program of an A100 (8.0), an RTX 4090 (8.9) and an H100 (9.0) may have, in bytes.
SHARED = {80: 163 << 10, 89: 99 << 10, 90: 227 << 10}
CODE = """
import json, re, sys
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from mplicits.neural_fields.kernels.launch import Network, tiling_of
from mplicits.neural_fields.kernels.levels import Levels, walk
from mplicits.neural_fields.kernels.paths import COLUMNS, march_bands
from mplicits.neural_fields.kernels.siren import evaluate
from mplicits.neural_fields.kernels.tiles import planes
from mplicits.neural_fields.kernels.tracing import march
from mplicits.neural_fields.kernels.training import sweep

kind, sizes, precision, capability = json.loads(sys.argv[1])
named = {"back": sweep, "march": march, "levels": walk, "levels jet": walk, "bands": march_bands}
kernel = named.get(kind, evaluate)
jet, ((width, depth), *_) = kind.endswith("jet"), sizes
tiling, warps = tiling_of(width), tiling_of(width).warps
constants = {
    "JET": jet, "PLANES": planes(depth, jet=jet), "ROWS": tiling.rows, "IN": 3, "WIDTH": width, "DEPTH": depth,
    "COLUMNS": tiling.columns, "PIECE": tiling.piece, "PRECISION": precision, "WANTED": True, "TAPERED": True,
    "PATIENCE": 32, "BOLDNESS": 0.9, "STEEPEST_RISE": 0.6, "FLOOR": 1e-6,
    "BAND_ENTRY": 0.5, "NUMBERS": COLUMNS,
}
numbers = ("omega", "gain", "tolerance", "resolution", "lipschitz", "taper")
parameters = ("*fp32",) * (2 * depth + 2)
types = {"parameters": parameters, "count": "i64", "share": "i64", "room": "i32", "max_steps": "i32"}
types |= {"lists": "*i64", "wanted": "*i8", "counts": "*i32", "found_level": "*i32"}
if len(sizes) > 1:  # all that matters of a network is its shape
    networks = [Network((torch.empty(w, 3),) * (2 * d + 2), 1.0, 1.0) for w, d in sizes]
    shape = Levels.of(networks, torch.ones(len(sizes) - 1), 0.5).shape(jet=jet)
    constants |= {"SIZES": shape.sizes, "FLOATS": shape.floats}
    types |= {"parameters": tuple(("*fp32",) * len(one.parameters) for one in networks)}
    types |= dict.fromkeys(("omegas", "gains"), ("fp32",) * len(sizes))
    warps = shape.warps
types |= {"found_mask": "*i8", "found_steps": "*i32", **dict.fromkeys(numbers, "fp32")}
names = kernel.arg_names
source = ASTSource(
    kernel,
    {name: "constexpr" if name in constants else types.get(name, "*fp32") for name in names},
    {(names.index(name),): constant for name, constant in constants.items() if name in names},
)
options = {"num_warps": warps, "num_stages": 2}
compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
ptx = compiled.asm["ptx"]
print(json.dumps({"shared": compiled.metadata.shared, "fast": len(re.findall(r"(sin|cos)[.]approx", ptx)),
                  "tensor": len(re.findall("mma", ptx))}))
"""


def compiled(kind: str, sizes: list[tuple[int, int]], *, precision: str, capability: int) -> dict[str, int]:
    """What became of a kernel: bytes of shared memory, how many fast sines, how many products on tensor cores."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_DEFAULT_FP_FUSION"] = "1"
    words = [sys.executable, "-c", CODE, json.dumps([kind, sizes, precision, capability])]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def test_a_jet_compiles_for_a_hopper() -> None:
    found = compiled("jet", [(16, 2)], precision="ieee", capability=90)
    assert found["shared"] <= SHARED[90]
    assert (found["fast"], found["tensor"]) == (0, 0)  # sines of libdevice, products of float32 units


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "capability"), [("ieee", 80), ("ieee", 90), ("tf32", 89), ("tf32x3", 90)])
@pytest.mark.parametrize(
    ("kind", "sizes"),
    [
        *((kind, [(128, 2)]) for kind in ("value", "jet", "back", "march")),
        ("jet", [(128, 3)]),
        ("jet", [(400, 2)]),
        *((kind, [(128, 2), (256, 2), (400, 2)]) for kind in ("levels", "levels jet", "bands")),
    ],
)
def test_kernels_compile(kind: str, sizes: list[tuple[int, int]], precision: str, capability: int) -> None:
    found = compiled(kind, sizes, precision=precision, capability=capability)
    assert found["shared"] <= SHARED[capability]
    assert found["fast"] == 0
    assert (found["tensor"] > 0) == (precision != "ieee")


LAUNCHED = """
import json, sys
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from mplicits.neural_fields import MultiscaleSDF
from mplicits.neural_fields.kernels import cones, levels, paths, siren, tracing, training

class Hopper:  # all that binding and compiling ask of a driver
    def get_current_device(self):
        return 0
    def get_current_stream(self, device):
        return 0
    def get_current_target(self):
        return GPUTarget("cuda", 90, 32)
    def get_active_torch_device(self):
        return torch.device("cpu")

driver.set_active(Hopper())
launched = []

def stop_short(module, name):
    kernel = getattr(module, name)
    class Bound:
        def __getitem__(self, grid):
            def call(*arguments, **options):
                kernel.warmup(*arguments, grid=grid, **options)
                launched.append(f"{module.__name__.split('.')[-1]}.{name}")
            return call
    setattr(module, name, Bound())

places = ((siren, "evaluate"), (levels, "walk"), (paths, "march_bands"), (tracing, "march"), (cones, "march"))
for module, name in (*places, (training, "sweep")):
    stop_short(module, name)
field = MultiscaleSDF.from_widths([(16, 1), (24, 2)], omegas=[5, 5], taper=0.3).requires_grad_(False)
x, depth, base, together = torch.rand(100, 3), torch.rand(100), field.base.as_network(), field.as_levels()
siren.siren_jet(x, base, "ieee")
levels.levels_value(x, together, "ieee", depth > 0.5)
levels.levels_jet(x, together, "tf32x3")
numbers = {"PATIENCE": 32, "BOLDNESS": 0.9, "STEEPEST_RISE": 0.6, "BAND_ENTRY": 0.5, "FLOOR": 1e-6}
options = {"tolerance": 1e-3, "resolution": 1e-3, "lipschitz": 1.0, "max_steps": 9, "constants": numbers}
rays = (x, x, depth, depth, depth + 1)
tracing.march_rays(base, rays, precision="ieee", **options)
paths.march_levels(together, rays, precision="ieee", **options)
cones.march_cones(base, (x[0], x, depth, depth, depth), depth[0], 1.0, 9, "ieee")
training.jet_backward(x, base, depth, x, "ieee")
print(json.dumps(launched))
"""


@pytest.mark.slow
def test_launches_are_bound_as_triton_binds_them() -> None:
    """What the interpreter does not show: types of arguments, tuples of tuples, a view of bits; then they compile."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_DEFAULT_FP_FUSION"] = "1"
    words = [sys.executable, "-c", LAUNCHED]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    expected = ["siren.evaluate", "levels.walk", "levels.walk", "tracing.march", "paths.march_bands", "cones.march"]
    assert json.loads(done.stdout) == [*expected, "training.sweep"]
