"""instant-nsr-pl: a copy with the document's lines, one training by the host's own system, and what came of it."""

import argparse
import shutil
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from .host_common import EVERY, LOOKS, MORE_STEPS, RAYS, RESOLUTION, applied, changes, in_ball, now, surface
from .nsr_packages import cpu_for_cuda, install

CONFIG = "configs/neus-dtu-wmask.yaml"
CELLS = 32  # of the occupancy grid along an axis; the host's 128 are for a GPU
CONSTANT = 5000 / 20_000  # share of the steps before the rate falls, as in the host's file


def set_up(args: argparse.Namespace, clone: Path, scene: Path, row: str, folder: Path) -> None:
    """A copy of the host in ``folder``, with the document's lines unless it is the host's row."""
    shutil.copytree(clone, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("exp", "runs", ".git"))
    for file, diff in changes("instant-nsr-pl") if row != "host" else []:
        path = folder / (CONFIG if file == ".yaml" else file)
        path.write_text(applied(path.read_text(), diff))
    if not torch.cuda.is_available():
        ranks, model = folder / "utils" / "misc.py", folder / "models" / "neus.py"
        ranks.write_text(ranks.read_text().replace("    return 0\n", '    return "cpu"\n'))
        model.write_text(model.read_text().replace("resolution=128", f"resolution={CELLS}"))
    views = len(list((scene / "image").glob("*.png")))
    held_out = list(range(0, views, EVERY))
    chosen(scene, [view for view in range(views) if view % EVERY], folder / "seen")
    chosen(scene, held_out, folder / "held_out")
    values = f"{args.rays} {args.samples} {args.steps}"
    (folder / "settings.txt").write_text(values)


def chosen(scene: Path, views: list[int], folder: Path) -> None:
    """Some views of a NeuS scene as a scene of their own, files named as the host wants them."""
    (folder / "image").mkdir(parents=True)
    (folder / "mask").mkdir()
    images, masks = (sorted((scene / part).glob("*.png")) for part in ("image", "mask"))
    with np.load(scene / "cameras_sphere.npz") as cameras:
        pairs = [(f"{key}_mat_", new, old) for new, old in enumerate(views) for key in ("world", "scale")]
        kept = {f"{name}{new}": cameras[f"{name}{old}"] for name, new, old in pairs}
    np.savez(folder / "cameras_sphere.npz", allow_pickle=False, **kept)
    for new, old in enumerate(views):
        shutil.copy(images[old], folder / "image" / f"{new:06d}.png")
        shutil.copy(masks[old], folder / "mask" / f"{new:03d}.png")


class Training:
    """The host's system, data and optimiser in the loop that Lightning would run."""

    def __init__(self, config: Any, scene: Any) -> None:
        import systems  # pyright: ignore[reportMissingImports]

        self.system = systems.make(config.system.name, config)
        loader = types.SimpleNamespace(dataset=scene)
        self.system.trainer = types.SimpleNamespace(datamodule=types.SimpleNamespace(train_dataloader=lambda: loader))
        made = self.system.configure_optimizers()
        self.optimizer, self.schedule = made["optimizer"], made["lr_scheduler"]["scheduler"]

    def step(self) -> None:
        """One training step, as Lightning would make it."""
        batch: dict[str, Tensor] = {}
        self.system.on_train_batch_start(batch, self.system.global_step)
        loss = self.system.training_step(batch, self.system.global_step)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        self.system.global_step += 1

    def state(self) -> tuple[list[dict[str, Any]], int]:
        """The states of the model, the optimizer and its schedule, and the number of steps."""
        parts = (self.system, self.optimizer, self.schedule)
        return [part.state_dict() for part in parts], self.system.global_step

    def load(self, state: tuple[list[dict[str, Any]], int]) -> None:
        """Go on from a `state`."""
        states, self.system.global_step = state
        for part, kept in zip((self.system, self.optimizer, self.schedule), states, strict=True):
            part.load_state_dict(kept)


@torch.no_grad()
def colors(system: Any, scene: Any) -> float:
    """Mean |c − ĉ| over fixed rays of all views of a scene, inside their masks."""
    from models.ray_utils import get_rays  # pyright: ignore[reportMissingImports]

    before, model = system.model.background_color, system.model
    model.eval()
    model.background_color = torch.ones(3)
    errors = []
    generator = torch.Generator().manual_seed(1)
    for view, mask in enumerate(scene.all_fg_masks):
        inside = (mask > 0.5).nonzero()
        y, x = inside[torch.randint(len(inside), (RAYS,), generator=generator)].unbind(-1)
        origins, directions = get_rays(scene.directions[view, y, x], scene.all_c2w[view].expand(RAYS, 3, 4))
        rays = torch.cat((origins, torch.nn.functional.normalize(directions, dim=-1)), dim=-1)
        errors.append((model(rays)["comp_rgb_full"] - scene.all_images[view, y, x]).abs().mean().item())
    model.train()
    model.background_color = before
    return float(np.mean(errors))


def work(scene: Path, seed: int) -> dict[str, Any]:
    """Train in the current folder, a copy of the host, and measure."""
    sys.path.insert(0, str(Path.cwd()))
    install()
    with cpu_for_cuda():
        return _work(scene, seed)


def _work(scene: Path, seed: int) -> dict[str, Any]:
    from datasets.dtu import DTUDatasetBase  # pyright: ignore[reportAttributeAccessIssue, reportMissingImports]
    from omegaconf import OmegaConf  # pyright: ignore[reportMissingImports]
    from utils.misc import load_config  # pyright: ignore[reportMissingImports]

    rays, samples, steps = map(int, Path("settings.txt").read_text().split())
    words = [f"trainer.max_steps={steps}", f"system.constant_steps={round(steps * CONSTANT)}"]
    words += [f"model.train_num_rays={rays}", f"model.num_samples_per_ray={samples}", "dataset.root_dir=seen"]
    words += ["dataset.img_downscale=1", f"model.geometry.isosurface.resolution={RESOLUTION}"]
    config = load_config(CONFIG, cli_args=words)
    seen, held_out = DTUDatasetBase(), DTUDatasetBase()
    seen.setup(config.dataset, "train")
    held_out.setup(OmegaConf.merge(config.dataset, {"root_dir": "held_out"}), "train")

    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    training = Training(config, seen)
    spent, way, every = 0.0, [], max(1, steps // LOOKS)
    for step in range(1, steps + 1):
        before = now()
        training.step()
        spent += now() - before
        if step % every == 0:
            way.append((spent, colors(training.system, held_out)))
    model, x = training.system.model, in_ball()
    slopes = torch.cat([model.geometry(part, True, False)[1].detach() for part in x.split(2000)])
    found = model.eval().isosurface()
    mesh = trimesh.Trimesh(found["v_pos"].numpy(), found["t_pos_idx"].numpy())
    result = {
        "parameters": sum(parameter.numel() for parameter in model.geometry.parameters()),
        "s/step": spent / steps,
        "colour": colors(training.system, held_out),
        "eikonal": ((slopes.norm(dim=1) - 1) ** 2).mean().item(),
        **surface(mesh, scene / "surface.ply"),
        "1/s": 1 / model.variance.inv_s.item(),
    }
    again = Training(config, seen)
    torch.save(training.state(), "last.ckpt")
    # The groups of the host's optimiser hold lists of omegaconf, which PyTorch reads only if told to trust the file.
    again.load(torch.load("last.ckpt", weights_only=False))
    model.eval()
    again.system.model.eval()
    same = torch.equal(again.system.model.geometry(x[:1000], False, False), model.geometry(x[:1000], False, False))
    again.system.model.train()
    for _ in range(MORE_STEPS):
        again.step()
    result["resumed"] = float(same and again.system.global_step == steps + MORE_STEPS)
    return {**result, "course": way}
