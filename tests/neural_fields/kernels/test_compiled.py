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
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from mplicits.neural_fields.kernels.launch import tiling_of
from mplicits.neural_fields.kernels.siren import evaluate
from mplicits.neural_fields.kernels.tiles import planes

width, depth, jet, precision, capability = json.loads(sys.argv[1])
tiling = tiling_of(width)
constants = {
    "JET": jet, "PLANES": planes(depth, jet=jet), "ROWS": tiling.rows, "IN": 3, "WIDTH": width, "DEPTH": depth,
    "COLUMNS": tiling.columns, "PIECE": tiling.piece, "PRECISION": precision,
}
types = {name: "*fp32" for name in ("x", "value", "gradient", "scratch")}
types |= {"parameters": ("*fp32",) * (2 * depth + 2), "count": "i64", "omega": "fp32", "gain": "fp32"}
names = evaluate.arg_names
source = ASTSource(
    evaluate,
    {name: "constexpr" if name in constants else types[name] for name in names},
    {(names.index(name),): constant for name, constant in constants.items()},
)
options = {"num_warps": tiling.warps, "num_stages": 2}
compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
ptx = compiled.asm["ptx"]
print(json.dumps({"shared": compiled.metadata.shared, "fast": len(re.findall(r"(sin|cos)[.]approx", ptx)),
                  "tensor": len(re.findall("mma", ptx))}))
"""


def compiled(width: int, depth: int, *, jet: bool, precision: str, capability: int) -> dict[str, int]:
    """What became of a kernel: bytes of shared memory, how many fast sines, how many products on tensor cores."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_DEFAULT_FP_FUSION"] = "1"
    words = [sys.executable, "-c", CODE, json.dumps([width, depth, jet, precision, capability])]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def test_a_jet_compiles_for_a_hopper() -> None:
    found = compiled(16, 2, jet=True, precision="ieee", capability=90)
    assert found["shared"] <= SHARED[90]
    assert (found["fast"], found["tensor"]) == (0, 0)  # sines of libdevice, products of float32 units


@pytest.mark.slow
@pytest.mark.parametrize("capability", SHARED)
@pytest.mark.parametrize("precision", ["ieee", "tf32x3", "tf32"])
@pytest.mark.parametrize(("width", "depth", "jet"), [(128, 2, False), (128, 2, True), (128, 3, True), (400, 2, True)])
def test_kernels_compile(width: int, depth: int, jet: bool, precision: str, capability: int) -> None:
    found = compiled(width, depth, jet=jet, precision=precision, capability=capability)
    assert found["shared"] <= SHARED[capability]
    assert found["fast"] == 0
    assert (found["tensor"] > 0) == (precision != "ieee")
