"""From photographs to a coloured mesh.

    python photographs.py                  # drawn ones, with exact cameras; minutes, more on a small machine
    python photographs.py photos/          # yours: COLMAP, transforms.json or NeuS folders
    python photographs.py --small          # seconds; shows the way, not the quality

Geometry and colours are trained together, so that rays through them give the pixels of the photographs (NeuS).
Leaves statue/, mesh.glb and picture.png in the folder that it is called from.
"""

import sys

from mplicits.datasets import SCENES, render_scene
from mplicits.pipelines.mesh.extract import MeshOptions, mesh_run
from mplicits.pipelines.reconstruct import reconstruct
from mplicits.pipelines.render.draw import RenderOptions, render_run
from mplicits.pipelines.training.settings import ReconstructConfig

small = "--small" in sys.argv
folders = [word for word in sys.argv[1:] if not word.startswith("--")]

# --- Photographs ----------------------------------------------------------------------------------------
# A photograph is of use with its camera: where it stood, where it looked, its focal length. COLMAP finds that for
# yours, and `mplicits check-cameras photos/` draws what it found. Here they are known, as the pictures are drawn.
if folders:
    photographs = folders[0]
else:
    photographs = render_scene(SCENES["painted-sphere"](), views=6 if small else 48, size=24 if small else 128)

# --- Training -------------------------------------------------------------------------------------------
if small:
    config = ReconstructConfig(
        widths=(32, 32), depths=(2, 2), omegas=(5.0, 10.0), color_width=32, color_depth=1, color_grid=8,
        steps=20, rays=64,
        uniform=16, importance=8, texture_steps=10, test_every=3,
    )  # fmt: skip
else:
    config = ReconstructConfig()
run = reconstruct(photographs, config, out="statue")

# Some photographs were held out. How near the model comes to those says more than how near it comes to the others.
print(f"held-out photographs: PSNR {run.record['held_out']['psnr']:.1f} dB")

# --- To keep --------------------------------------------------------------------------------------------
mesh = mesh_run("statue", "mesh.glb", MeshOptions(resolution=48 if small else 256))
render_run("statue", "picture.png", RenderOptions(size=(96,) if small else (512,)))
print(f"mesh.glb: {len(mesh.faces):,} triangles with colours, for Blender, three.js and others")
