"""NeuS: a copy with the document's lines, one training, and what came of it."""

import argparse
import re
import shutil
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from .host_common import EVERY, LOOKS, MORE_STEPS, RAYS, RESOLUTION, applied, changes, in_ball, now, surface

DEEPER = "[(128, 2), (256, 3)]", "[(128, 4), (256, 5)]"  # what `ours, deeper` changes: the paper's networks for images
SHORT = "Short trainings in NeuS"  # the section whose lines `--short` adds, the host's own row's too
ENCODED = "ours, 256 features"  # the other such rows have as many without an encoding


def set_up(args: argparse.Namespace, clone: Path, scene: Path, row: str, folder: Path) -> None:
    """A copy of the host in ``folder``, changed for one row, with the schedule squeezed into the given steps."""
    shutil.copytree(clone, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("exp", ".git"))
    runner, conf = folder / "exp_runner.py", folder / "confs" / "wmask.conf"
    wanted = [change for change in changes("NeuS") if row != "host" or "weights_only" in change[1]]
    for file, diff in [*wanted, *(changes(SHORT) if args.short else [])]:
        path = conf if file.endswith(".conf") else folder / file
        if path == conf and row != "ours":
            continue
        path.write_text(applied(path.read_text(), diff))
    if row.startswith("ours, "):  # beside 24 features of the encoding, or alone
        text = runner.read_text().replace("num_features=8", f"num_features={232 if row == ENCODED else 256}")
        text = text if row == ENCODED else text.replace("EncodedField(sdf)", "sdf")
        runner.write_text(text.replace(*DEEPER) if row == "ours, deeper" else text)
    if not torch.cuda.is_available():
        for path in folder.rglob("*.py"):
            path.write_text(path.read_text().replace("device('cuda')", "device('cpu')").replace(".cuda()", ".cpu()"))
    warm_up = max(1, round(args.steps * args.warm_up))
    settings: dict[str, Any] = {"end_iter": args.steps, "warm_up_end": warm_up, "batch_size": args.rays}
    settings |= dict.fromkeys(("val_freq", "val_mesh_freq", "report_freq"), 10**9) | {"save_freq": args.steps}
    settings |= {"n_samples": args.samples, "n_importance": args.samples}
    settings |= {"data_dir": scene.resolve(), "base_exp_dir": "./exp"}
    text = conf.read_text()
    for key, value in settings.items():
        text, times = re.subn(rf"(?m)^(\s*{key} = ).*$", rf"\g<1>{value}", text)
        assert times == 1, key
    conf.write_text(text)


class Course:
    """A stand-in for TensorBoard's writer, and the hook by which colours are looked at while the host trains."""

    def __init__(self) -> None:
        self.look: Any = None

    def add_scalar(self, name: str, _value: object, step: int) -> None:
        """Look at the colours at the end of each step."""
        if name == "Statistics/psnr" and self.look is not None:  # the last of a step
            self.look(step)


def colors(runner: Any, views: list[int]) -> float:
    """Mean |c − ĉ| over fixed rays of these views, inside their masks."""
    errors = []
    with torch.random.fork_rng():
        torch.manual_seed(1)
        for view in views:
            data = runner.dataset.gen_random_rays_at(view, RAYS)
            data = data[data[:, 9] > 0.5]
            near, far = runner.dataset.near_far_from_sphere(data[:, :3], data[:, 3:6])
            seen = runner.renderer.render(data[:, :3], data[:, 3:6], near, far, perturb_overwrite=0, cos_anneal_ratio=1)
            errors.append((seen["color_fine"].detach() - data[:, 6:9]).abs().mean().item())
    return float(np.mean(errors))


def eikonal(slopes: torch.Tensor) -> float:
    """Mean (|∇f| − 1)² of gradients ``(N, 3)``."""
    return ((slopes.norm(dim=1) - 1) ** 2).mean().item()


def work(scene: Path, seed: int) -> dict[str, Any]:
    """One training in a copy of the host, as its ``__main__`` would do it, and what came of it."""
    sys.path.insert(0, str(Path.cwd()))
    course, board = Course(), types.ModuleType("torch.utils.tensorboard")
    vars(board)["SummaryWriter"] = lambda **_: course
    sys.modules["torch.utils.tensorboard"] = board
    if torch.cuda.is_available():
        torch.set_default_device("cuda")
    from exp_runner import Runner  # pyright: ignore[reportMissingImports]

    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    runner = Runner("confs/wmask.conf")
    held_out = list(range(0, runner.dataset.n_images, EVERY))
    seen = torch.tensor([view for view in range(runner.dataset.n_images) if view % EVERY])
    runner.get_image_perm = lambda: seen[torch.randperm(len(seen))]
    start, spent, way = now(), 0.0, []
    every = max(1, runner.end_iter // LOOKS)

    def look(step: int) -> None:
        nonlocal spent
        if step % every == 0:
            before = now()
            way.append((before - start - spent, colors(runner, held_out)))
            spent += now() - before

    course.look = look
    runner.train()
    seconds, course.look = now() - start - spent, None

    x = in_ball()
    network = runner.sdf_network
    slopes = torch.cat([network.gradient(part)[:, 0].detach() for part in x.split(2000)])
    box = (torch.tensor(bound, dtype=torch.float32) for bound in ([-1.01] * 3, [1.01] * 3))
    mesh = trimesh.Trimesh(*runner.renderer.extract_geometry(*box, resolution=RESOLUTION))
    parameters = [parameter.numel() for parameter in network.parameters()]
    ours = hasattr(network, "field")
    result = {
        "parameters": sum(parameters),
        "s/step": seconds / runner.end_iter,
        "colour": colors(runner, held_out),
        "eikonal": eikonal(slopes),
        **({"of level 0": eikonal(network.field.jet(network.scale * x, level=0).gradient.detach())} if ours else {}),
        **surface(mesh, scene / "surface.ply"),
        "1/s": float(1 / runner.deviation_network(torch.zeros([1, 3]))[0, 0]),
    }
    conf = Path("confs/wmask.conf")
    text = conf.read_text()
    conf.write_text(re.sub(r"(end_iter = )\d+", rf"\g<1>{runner.end_iter + MORE_STEPS}", text))
    again = Runner("confs/wmask.conf", is_continue=True)
    same = torch.equal(again.sdf_network.sdf(x[:1000]), runner.sdf_network.sdf(x[:1000]))
    again.train()
    result["resumed"] = float(same and again.iter_step == runner.end_iter + MORE_STEPS)
    return {**result, "course": way}
