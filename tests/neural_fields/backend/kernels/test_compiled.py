"""The kernels compile for GPUs that are not here, without spilt registers, and with a swizzle in shared memory.

Triton brings the whole compiler, which needs no device; the interpreter accepts more than the compiler.
"""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

# Shared memory that a program of an A100 (8.0), an RTX 4090 (8.9) and an H100 (9.0) may have, in bytes.
SHARED = {80: 163 << 10, 89: 99 << 10, 90: 227 << 10}
# Bytes of registers that a thread may put into memory: 200 to 1,300 today, 10,000 and more with an unsuitable layout.
SPILLED = 2048

CODE = """
import json, re, subprocess, sys, tempfile
from pathlib import Path
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

sizes, capability, of_training = json.loads(sys.argv[1])

class Stub:  # all that binding and compiling ask of a driver
    def get_current_device(self):
        return 0
    def get_current_stream(self, device):
        return 0
    def get_current_target(self):
        return GPUTarget("cuda", capability, 32)
    def get_active_torch_device(self):
        return torch.device("cpu")

driver.set_active(Stub())
found = {}
tools = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"

def compile_only(kernel, *arguments, grid, warmup, **options):
    made = original(kernel, *arguments, grid=grid, warmup=True, **options)
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(made.asm["cubin"])
        file.flush()
        words = [tools / "cuobjdump", "--dump-resource-usage", file.name]
        said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found[f"{kernel.fn.__module__.split('.')[-1]}.{kernel.fn.__name__}"] = {
        "shared": made.metadata.shared, "warps": made.metadata.num_warps,
        "spilled": int(re.search(r"STACK:([0-9]+)", said)[1]),
        "fast": len(re.findall(r"(sin|cos)[.]approx", made.asm["ptx"])),
        "tensor": len(re.findall("mma", made.asm["ptx"])),
        # How matrices lie in shared memory: the bytes of a swizzle for Hopper's products, its phases for others.
        "bytes": [int(number) for number in re.findall("swizzlingByteWidth = ([0-9]+)", made.asm["ttgir"])],
        "phases": [int(number) for number in re.findall("maxPhase = ([0-9]+)", made.asm["ttgir"])],
    }

original, JITFunction.run = JITFunction.run, compile_only

from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import MultiscaleSDF
from mplicits.neural_fields.backend.kernels import levels, packing, siren, training
from mplicits.neural_fields.backend.kernels.launch import Network
from mplicits.neural_fields.networks.multiscale import as_levels
from mplicits.neural_fields.tracing import picture
from mplicits.pipelines.render import trace

packing.is_hopper = lambda device: capability == 90
field = MultiscaleSDF.from_widths(sizes, omegas=[30.0] * len(sizes), taper=0.3).requires_grad_(False)
x, depth = torch.rand(100, 3), torch.rand(100)
if of_training:
    network = Network.of(field.base.raw(), 30.0, 1.0)
    training.jet(x, network)
    training.jet_backward(x, network, depth, x)
else:
    siren.siren_value(x, packing.packed(field.base))
    siren.siren_jet(x, packing.packed(field.base))
    if len(sizes) > 1:
        levels.levels_value(x, as_levels(field), depth > 0.5)
    trace._draws_at_once = lambda *_: True
    picture.Picture.draw = lambda self, view: self._launch() or picture.Drawn(*(part[:0] for part in self.drawn))
    trace.trace_view(field, look_at((1.6, 0.9, 2.0), (0.0, 0.0, 0.0), fov=40.0, width=64, height=64))
print(json.dumps(found))
"""


def compiled(sizes: list[tuple[int, int]], capability: int, *, training: bool = False) -> dict[str, dict[str, Any]]:
    """What became of the kernels of a field's values, jets and pictures, or of its training's jets, by their names."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_DEFAULT_FP_FUSION"] = "1"
    words = [sys.executable, "-c", CODE, json.dumps([sizes, capability, training])]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def assert_sound(found: dict[str, dict[str, Any]], capability: int) -> None:
    for name, kernel in found.items():
        assert kernel["shared"] <= SHARED[capability], name
        assert kernel["spilled"] <= SPILLED, name
        assert kernel["fast"] == 0, name  # no sine of low accuracy


PICTURE = {"make_rays", "make_cones", "begin_rays", "count_hits", "place_hits", "see_hits"}
PICTURE = {f"picture.{name}" for name in PICTURE}


def test_a_picture_of_one_small_level_compiles_for_a_hopper() -> None:
    found = compiled([(16, 2)], 90)
    assert set(found) == {*PICTURE, "siren.evaluate", "cones.march", "tracing.march", "levels.walk"}
    assert_sound(found, 90)
    assert all(found[name]["tensor"] for name in ("siren.evaluate", "cones.march", "tracing.march", "levels.walk"))


@pytest.mark.slow
@pytest.mark.parametrize("capability", [80, 89, 90])
@pytest.mark.parametrize("sizes", [[(128, 2), (256, 2), (400, 2)], [(128, 3), (512, 1)]])
def test_kernels_compile(sizes: list[tuple[int, int]], capability: int) -> None:
    found = compiled(sizes, capability)
    assert set(found) == {*PICTURE, "siren.evaluate", "cones.march", "levels.walk", "paths.march_bands"}
    assert_sound(found, capability)
    for name in ("siren.evaluate", "cones.march", "levels.walk", "paths.march_bands"):
        assert found[name]["tensor"] > 0
        # Without a swizzle all threads of a warp would read the same banks.
        if capability == 90:
            assert min(found[name]["bytes"], default=0) >= 32, name
        else:
            assert max(found[name]["phases"], default=1) >= 4, name


@pytest.mark.slow
@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize("size", [(128, 2), (400, 2)])
def test_jets_of_training_compile(size: tuple[int, int], capability: int) -> None:
    found = compiled([size], capability, training=True)
    assert set(found) == {"training.evaluate", "training.sweep"}
    assert_sound(found, capability)
    assert not any(kernel["tensor"] for kernel in found.values())  # their products are those of float32 units
