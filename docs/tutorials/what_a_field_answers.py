# %% [markdown]
# # What a field answers
#
# A mesh says where a surface is. A signed distance field says how far away it is, from any point, and which
# way. Many questions are one line then. Here: collisions, offsets and walls for printing, thickness, and two
# fits made one.
#
# Needs `pip install mplicits`, nothing else. This page is a notebook and a script (`python
# what_a_field_answers.py`); both are run by the tests. With `--small`, or `SMALL=1` in the environment, it
# takes seconds.

# %%
import os
import sys

import mplicits
import numpy as np
from mplicits.datasets import sample_surface
from mplicits.neural_fields import Box, Torus

small = "--small" in sys.argv or bool(os.environ.get("SMALL"))
resolution = 32 if small else 192

# %% [markdown]
# ## Two fits
#
# Two clouds of points in one coordinate system, in millimetres: a ring, and a bar across it. Each is fitted
# in a unit sphere of its own. `mplicits.fit("ring.ply")` would take a file; `run.world` answers in
# millimetres.

# %%
few = mplicits.FitConfig(
    widths=(48, 64), depths=(2, 2), omegas=(8.0, 25.0), steps=(120, 40) if small else (600, 300),
    learning_rates=(5e-3, 1e-3), batch=1024 if small else 4096, samples=10_000 if small else 100_000,
)  # fmt: skip


def fitted(shape, millimetres):
    cloud = sample_surface(shape, 3000 if small else 20_000)
    points = np.hstack((millimetres * cloud.points, cloud.normals))
    return mplicits.fit(points, few).world


ring = fitted(Torus(major=0.6, minor=0.2), 50.0)  # 80 mm across, 20 mm thick
bar = fitted(Box(half_size=(0.7, 0.2, 0.12)), 50.0)  # 70 by 20 by 12 mm, so that its ends lie in the ring

# %% [markdown]
# ## How far, and which way
#
# Numpy in, numpy out. Negative is inside. A field knows what it was trained on: the box around the unit sphere of
# its points. Near the surface it is right; where several points of the surface are equally near, as in the core of
# the tube or the middle of its hole, a distance has a ridge, and a small network rounds it off. It says too little
# there, which is the safe side for a ray and for a robot.

# %%
places = np.array([[30.0, 0.0, 14.0], [17.0, 0.0, 0.0], [0.0, 28.0, -9.0], [0.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
truth = np.hypot(np.hypot(places[:, 0], places[:, 1]) - 30, places[:, 2]) - 10
for place, distance, exact in zip(places, ring.distance(places), truth, strict=True):
    print(f"{place}: {distance:6.2f} mm; the truth is {exact:6.2f}" + (", on a ridge" if abs(exact) >= 10 else ""))
print("nearest to the first two:", ring.closest(places[:2]).position.round(1).tolist(), "mm")

# %% [markdown]
# ## Do they collide?
#
# Points on one surface, asked of the other field: the most negative answer is how deep they overlap, short on
# ridges as above. No search over pairs of triangles; a thousand points are one evaluation.

# %%
surface_of_bar = bar.mesh(resolution=32).vertices
depth = ring.distance(surface_of_bar)
print(f"{(depth < 0).mean():.0%} of the bar's surface lies inside the ring, up to {-depth.min():.1f} mm deep")

free = surface_of_bar + np.array([0.0, 0.0, 25.0])
print(f"lifted by 25 mm, it keeps {ring.distance(free).min():.1f} mm away")

# %% [markdown]
# ## One solid
#
# Union, intersection and difference are the minimum and the maximum of two distances, and fields again: they
# can be traced, meshed, saved. The fits may live anywhere; they are brought into one frame. `smooth` blends
# the seam, in millimetres.

# %%
joined = ring.union(bar, smooth=4.0)
slotted = ring.difference(bar.offset(0.3))  # a slot that the bar fits into, with 0.3 mm to spare


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


for name, shape in (("ring", ring), ("bar", bar), ("joined", joined), ("slotted", slotted)):
    print(f"{name}: {volume(shape.mesh(resolution)) / 1000:.1f} cm³")

# %% [markdown]
# ## A wall to print
#
# A shell is what lies within a few millimetres of the surface. The field's own level sets are good near the
# surface; far from it they are those of the coarsest level, and of what training left between the points.
# Where a wall must be exact, use `mplicits offset RUN --by -2mm --shell --unit mm -o wall.stl`: it measures
# from the finished mesh, and refuses walls that the resolution cannot hold.

# %%
wall = ring.shell(inside=3.0)
print(f"hollow, with walls of 3 mm: {volume(wall.mesh(resolution)) / 1000:.1f} cm³ instead of "
      f"{volume(ring.mesh(resolution)) / 1000:.1f}; the truth is 30.2 and 59.2")  # fmt: skip

# %% [markdown]
# ## How thick is it?
#
# From a point of the surface a ray goes inwards, until it comes out. That length is the thickness there: a
# printer's minimum is one comparison away. Rays that start inside look for the way out.

# %%
mesh = joined.mesh(resolution)
chosen = np.random.default_rng(0).permutation(len(mesh.vertices))[:500]
points, normals = mesh.vertices[chosen], mesh.normals[chosen].astype(float)
inside = points - 0.5 * normals  # half a millimetre below the surface
hits = joined.trace(inside, -normals)
thickness = hits.depth[hits.mask] + 0.5
print(f"thinnest {thickness.min():.1f} mm, usually {np.median(thickness):.1f} mm; the bar is 12 mm high, the ring 20")

# %% [markdown]
# ## To keep

# %%
joined.mesh(resolution).export("joined.stl")
joined.render("joined.png", size=96 if small else 512, up="z")
mplicits.save("joined.safetensors", joined)
print("joined.stl, joined.png, joined.safetensors; `mplicits view joined.safetensors --up z` turns it in the browser")
