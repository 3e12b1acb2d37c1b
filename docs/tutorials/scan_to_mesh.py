"""From a scan to a mesh to keep.

    python scan_to_mesh.py                 # a small simulated scan, so that there is something to fit
    python scan_to_mesh.py my_scan.ply     # your own: PLY, OBJ, STL, XYZ, LAS, ...
    python scan_to_mesh.py --small         # seconds instead of minutes, and a shape to match

Leaves scan.ply, run/, mesh.ply and picture.png in the folder that it is called from.
"""

import sys

import mplicits
from mplicits.datasets import simulate_scan, write_cloud_ply

small = "--small" in sys.argv
files = [word for word in sys.argv[1:] if not word.startswith("--")]

# --- A scan ---------------------------------------------------------------------------------------------
# Four range scanners stand around a ball on a plinth. Each sees what nothing hides, with a little noise.
# Fields are put together like sets; `smooth` is the width of the seam that is blended.
if files:
    scan = files[0]
else:
    shape = mplicits.Union(
        mplicits.Sphere(radius=0.5, center=(0.0, 0.0, 0.2)),
        mplicits.neural_fields.Box(half_size=(0.45, 0.45, 0.1), center=(0.0, 0.0, -0.45)),
        smooth=0.1,
    )
    scan = "scan.ply"
    write_cloud_ply(scan, simulate_scan(shape, scanners=4, resolution=24 if small else 96))

# --- The fit --------------------------------------------------------------------------------------------
# A small coarse network learns the distance to the points everywhere. Each further one is trained, and later
# evaluated, only in a narrow band around the surface of the one before. The defaults take about three minutes.
if small:
    config = mplicits.FitConfig(
        widths=(32, 48), depths=(2, 2), omegas=(10.0, 30.0), steps=(150, 50), learning_rates=(5e-3, 1e-3),
        batch=1024, samples=10_000,
    )  # fmt: skip
else:
    config = mplicits.FitConfig()
run = mplicits.fit(scan, config, out="run")

# --- What came out --------------------------------------------------------------------------------------
# `run.world` answers in the coordinates and units of the scan. Level 0 is the coarse network alone.
cloud = mplicits.datasets.read_cloud(scan)
for level in range(run.field.num_levels):
    misses = abs(run.world.distance(cloud.points, level=level)).mean()
    print(f"level {level}: the points of the scan lie {misses:.2g} from the surface, on average")

# --- To keep --------------------------------------------------------------------------------------------
mesh = run.world.mesh(resolution=64 if small else 256)
mesh.export("mesh.ply")  # or .obj, .stl, .glb
run.world.render("picture.png", size=96 if small else 512, up="z")
print(f"mesh.ply: {len(mesh.faces):,} triangles; picture.png shows it; `mplicits view run` turns it in the browser")
