"""Shape interpolation: a ball becomes a torus, as one field of space and time.

    python shape_interpolation.py
    python shape_interpolation.py --small   # seconds, and a rough film

A field of four coordinates f(x, y, z, t) holds every shape in between. Two shapes are given, at t = 0 and t = 1;
in between the surface moves along its normals towards the second one, which is a law that the training enforces.
Leaves morph/, halfway.ply and morph.gif in the folder that it is called from.
"""

import sys

import mplicits
from mplicits.pipelines.evolve import evolve
from mplicits.pipelines.evolve.animate import SequenceOptions, animate_run
from mplicits.pipelines.training.settings import EvolveConfig

small = "--small" in sys.argv
shapes = ("sphere:0.5", "torus:0.5,0.2")  # or two run directories: ("runs/cat", "runs/dog")

if small:
    config = EvolveConfig(
        shapes=shapes, widths=(32,), depths=(2,), omegas=(8.0,), steps=(60,), learning_rates=(5e-3,),
        data_weights=(100.0,), start_steps=60, batch=512, samples=4000, frames=2, resolution=24,
    )  # fmt: skip
else:
    config = EvolveConfig(shapes=shapes)
run = evolve(config, out="morph")

# At one moment it is a field like any other: distances, rays, meshes.
halfway = mplicits.load("morph", time=0.5)
print("at the origin the distance goes from", ", ".join(
    f"{float(mplicits.load('morph', time=t).distance([[0.0, 0.0, 0.0]])[0]):+.2f} at t = {t}" for t in (0.0, 0.5, 1.0)
))  # fmt: skip
halfway.mesh(resolution=40 if small else 128).export("halfway.ply")

# And all moments are a film.
options = SequenceOptions(frames=4 if small else 48, size=(96, 96) if small else (480, 480))
print("morph.gif:", animate_run("morph", "morph.gif", options))
