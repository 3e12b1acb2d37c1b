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
