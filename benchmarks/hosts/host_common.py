"""What the scripts of both hosts share: the document's changes, and what is measured of a surface."""

import re
import time
from pathlib import Path

import torch
import trimesh
from scipy.spatial import KDTree
from torch import Tensor

DOCUMENT = Path(__file__).parents[2] / "docs" / "drop-in.md"
NAMED_FILE = re.compile(r"`([\w/.]*\.(?:py|conf|yaml))`|^```diff\n(.*?)^```", re.MULTILINE | re.DOTALL)
EVERY = 8  # views from one that is held out to the next
LOOKS = 3  # at the colours in the course of a training
RAYS, POINTS = 128, 20_000  # of a held-out view; in the ball and on each surface
RESOLUTION = 64  # of meshes, as NeuS has while it trains
MORE_STEPS = 5  # after the resume


def changes(section: str) -> list[tuple[str, str]]:
    """(file, diff) of one section of the document, in its order."""
    text = DOCUMENT.read_text(encoding="utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    file, found = "", []
    for token in NAMED_FILE.finditer(text):
        if token[2]:
            found.append((file, token[2]))
        else:
            file = token[1]
    return found


def applied(text: str, diff: str) -> str:
    """The text with one change made, where its old lines stand, or at its end if it has none."""
    lines = diff.splitlines(keepends=True)
    old = "".join(line[1:] for line in lines if line[0] != "+")
    new = "".join(line[1:] for line in lines if line[0] != "-")
    if not old:
        return text + "\n" + new
    if old not in text:
        raise SystemExit(f"these lines of {DOCUMENT.name} are not in the host:\n{old}")
    return text.replace(old, new)


def now() -> float:
    """Seconds of the processor without a GPU: others may be at work beside us."""
    return time.perf_counter() if torch.cuda.is_available() else time.process_time()


def in_ball() -> Tensor:
    """Points of the unit ball ``(N, 3)``, always the same."""
    generator = torch.Generator().manual_seed(1)
    x = torch.nn.functional.normalize(torch.randn(POINTS, 3, generator=generator), dim=1)
    return (x * torch.rand(POINTS, 1, generator=generator) ** (1 / 3)).to(torch.get_default_device())


def surface(mesh: trimesh.Trimesh, truth: Path) -> dict[str, float]:
    """What the mesh is, and its mean distance to the true surface and back, halved."""
    found = {"parts": float(mesh.body_count), "watertight": float(mesh.is_watertight)}
    if truth.is_file() and len(mesh.faces):
        exact = trimesh.load_mesh(truth)
        ours, theirs = (trimesh.sample.sample_surface(side, POINTS, seed=0)[0] for side in (mesh, exact))
        there, back = KDTree(theirs).query(ours)[0], KDTree(ours).query(theirs)[0]
        found["Chamfer"] = float(there.mean() + back.mean()) / 2
    return found
