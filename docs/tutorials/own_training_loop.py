"""A training loop of your own: a coarse level, its band, and a residual inside it, in plain PyTorch.

    python own_training_loop.py
    python own_training_loop.py --small    # a few seconds

`mplicits.fit` does all of this, with noise, strays and resuming. Here is what happens inside, in the order of the
paper: fit f_0 everywhere, measure how far it misses the surface, fit r_1 where |f_0| is smaller than that.
Leaves field.safetensors and mesh.ply in the folder that it is called from.
"""

import sys

import mplicits
import torch
from mplicits.neural_fields import Torus

small = "--small" in sys.argv
torch.manual_seed(0)

# The surface to learn. All that the loop asks of it are distances and normals at points: any source of those will do.
truth = Torus(major=0.55, minor=0.25)


def train(network, field, steps, draw, rate):
    """Fit the distances and normals of `truth` at the points that `draw` makes, by changing `network` alone."""
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for step in range(steps):
        x = draw(1024)
        target, jet = truth.jet(x), field.jet(x)  # value and gradient from one evaluation, both differentiable
        distance = (jet.value - target.value).square().mean()
        angle = (1 - torch.cosine_similarity(jet.gradient, target.gradient, dim=-1)).mean()
        eikonal = (jet.gradient.norm(dim=-1) - 1).square().mean()
        loss = 1000 * distance + angle + 0.1 * eikonal
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
        if step % max(1, steps // 4) == 0:
            print(f"  step {step:4d}: loss {loss.item():.4f}")


def everywhere(count):
    return 2 * torch.rand(count, 3) - 1


def near_surface(count, width):
    """Points of the surface, moved up to `width` along their normals."""
    x = everywhere(count)
    jet = truth.jet(x)
    x = x - jet.value[:, None] * jet.gradient  # the closest point, as `truth` is an exact distance
    return x + width * (2 * torch.rand(count, 1) - 1) * jet.gradient


print("level 0: a small SIREN, everywhere")
base = mplicits.Siren(64, 2, omega=10.0)
field = mplicits.MultiscaleSDF(base, [], [])
train(base, field, 60 if small else 400, everywhere, 3e-3)

# The band must hold the true surface: as wide as the largest miss of level 0 at points of it, and a third more.
on_surface = near_surface(5000, 0.0)
with torch.no_grad():
    misses = field(on_surface).abs()
delta = 1.3 * float(misses.max())
print(f"level 0 misses the surface by {misses.mean():.2g} on average, {misses.max():.2g} at most: delta = {delta:.2g}")

print("level 1: a residual, only where |f_0| < delta")
residual = mplicits.Siren(96, 2, omega=30.0, output_gain=0.1)  # begins close to nothing
field = field.with_level(residual, delta=delta)
base.requires_grad_(False)  # levels are trained one after the other
train(residual, field, 30 if small else 300, lambda count: near_surface(count, delta), 1e-3)

with torch.no_grad():
    for level in range(field.num_levels):
        print(f"level {level}: misses the surface by {field(on_surface, level=level).abs().mean():.2g} on average")

mplicits.save("field.safetensors", field)  # `mplicits render field.safetensors -o picture.png` draws it
mplicits.extract_mesh(field, resolution=48 if small else 192).export("mesh.ply")
print("field.safetensors and mesh.ply are yours")
