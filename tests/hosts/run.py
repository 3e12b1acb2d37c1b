"""Trains NeuS as it is, and with our geometry in it by the lines of docs/drop-in.md; prints what each cost and gave.

    python tests/hosts/run.py --neus path/to/NeuS --data path/to/dtu_scan24 --steps 240 --rays 64 --seeds 0 1 2

The clone and the data stay as they are: what is run is a copy in a temporary folder, in which the document's lines are
changed (``ours``), its other colour network is not (``ours, 256 features``), or nothing is (``host``), and ``cuda`` is
``cpu`` where there is no GPU. NeuS's own packages have to be there: ``pip install pyhocon icecream tqdm PyMCubes``.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

DOCUMENT = Path(__file__).parents[2] / "docs" / "drop-in.md"
ROWS = ("host", "ours", "ours, 256 features")
NAMED_FILE = re.compile(r"`([\w/.]*\.(?:py|conf))`|^```diff\n(.*?)^```", re.MULTILINE | re.DOTALL)
RESOLUTION = 64  # NeuS's own while it trains
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
    """The text with one change made, where its old lines stand."""
    lines = diff.splitlines(keepends=True)
    old = "".join(line[1:] for line in lines if line[0] != "+")
    new = "".join(line[1:] for line in lines if line[0] != "-")
    if old not in text:
        raise SystemExit(f"these lines of {DOCUMENT.name} are not in the host:\n{old}")
    return text.replace(old, new)


def set_up(args: argparse.Namespace, row: str, folder: Path) -> None:
    """A copy of the host in ``folder``, changed for one row, with the schedule squeezed into so many steps."""
    shutil.copytree(args.neus, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("exp", ".git"))
    runner, conf = folder / "exp_runner.py", folder / "confs" / "wmask.conf"
    for file, diff in changes("NeuS"):
        if row == "host" and "weights_only" not in diff:
            continue
        path = conf if file.endswith(".conf") else folder / file
        if path == conf and row == "ours, 256 features":
            continue
        path.write_text(applied(path.read_text(), diff))
    if row == "ours, 256 features":
        runner.write_text(runner.read_text().replace("num_features=32", "num_features=256"))
    if not torch.cuda.is_available():
        for path in folder.rglob("*.py"):
            path.write_text(path.read_text().replace("device('cuda')", "device('cpu')").replace(".cuda()", ".cpu()"))
    warm_up = max(1, round(args.steps * args.warm_up))
    settings: dict[str, Any] = {"end_iter": args.steps, "warm_up_end": warm_up, "batch_size": args.rays}
    settings |= {"save_freq": args.steps, "val_freq": 10**9, "val_mesh_freq": 10**9, "report_freq": 10**9}
    settings |= {"data_dir": args.data.resolve(), "base_exp_dir": "./exp"}
    text = conf.read_text()
    for key, value in settings.items():
        text, times = re.subn(rf"(?m)^(\s*{key} = ).*$", rf"\g<1>{value}", text)
        assert times == 1, key
    conf.write_text(text)


def work(folder: Path, seed: int) -> dict[str, float]:
    """One training in a copy of the host, as its ``__main__`` would do it, and what came of it."""
    sys.path.insert(0, str(folder))
    board: Any = types.ModuleType("torch.utils.tensorboard")
    board.SummaryWriter = lambda **_: types.SimpleNamespace(add_scalar=lambda *_: None)
    sys.modules["torch.utils.tensorboard"] = board
    if torch.cuda.is_available():
        torch.set_default_device("cuda")
    from exp_runner import Runner  # pyright: ignore[reportMissingImports]

    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    clock = time.perf_counter if torch.cuda.is_available() else time.process_time  # others may be at work beside us
    runner = Runner("confs/wmask.conf")
    start = clock()
    runner.train()
    seconds = clock() - start

    torch.manual_seed(1)
    errors = []
    for image in range(0, runner.dataset.n_images, 7):
        data = runner.dataset.gen_random_rays_at(image, 128)
        near, far = runner.dataset.near_far_from_sphere(data[:, :3], data[:, 3:6])
        seen = runner.renderer.render(data[:, :3], data[:, 3:6], near, far, perturb_overwrite=0, cos_anneal_ratio=1.0)
        mask = data[:, 9:10] > 0.5
        errors.append((seen["color_fine"].detach() - data[:, 6:9]).abs()[mask[:, 0]].mean().item())
    x = torch.nn.functional.normalize(torch.randn(20_000, 3), dim=1) * torch.rand(20_000, 1) ** (1 / 3)
    slopes = torch.cat([runner.sdf_network.gradient(part)[:, 0].detach() for part in x.split(2000)])
    box = (torch.tensor(bound, dtype=torch.float32) for bound in ([-1.01] * 3, [1.01] * 3))
    mesh = trimesh.Trimesh(*runner.renderer.extract_geometry(*box, resolution=RESOLUTION))
    parameters = [parameter.numel() for parameter in runner.sdf_network.parameters()]
    result = {
        "parameters": sum(parameters),
        "s/step": seconds / runner.end_iter,
        "colour": float(np.mean(errors)),
        "eikonal": ((slopes.norm(dim=1) - 1) ** 2).mean().item(),
        "parts": float(mesh.body_count),
        "watertight": float(mesh.is_watertight),
        "1/s": float(1 / runner.deviation_network(torch.zeros([1, 3]))[0, 0]),
    }
    conf = Path("confs/wmask.conf")
    text = conf.read_text()
    conf.write_text(re.sub(r"(end_iter = )\d+", rf"\g<1>{runner.end_iter + MORE_STEPS}", text))
    again = Runner("confs/wmask.conf", is_continue=True)
    same = torch.equal(again.sdf_network.sdf(x[:1000]), runner.sdf_network.sdf(x[:1000]))
    again.train()
    result["resumed"] = float(same and again.iter_step == runner.end_iter + MORE_STEPS)
    return result


def main() -> None:
    """Run the rows, each in a process of its own, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--neus", type=Path, required=True, help="clone of NeuS")
    parser.add_argument("--data", type=Path, required=True, help="a scene as NeuS wants it: image/, mask/, cameras")
    parser.add_argument("--steps", type=int, default=240)
    parser.add_argument("--rays", type=int, default=64, help="per step; NeuS has 512")
    parser.add_argument("--warm-up", type=float, default=5000 / 300_000, help="share of the steps; NeuS's by default")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--work", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work is not None:
        print("\n" + json.dumps(work(Path.cwd(), args.work)))
        return
    for row in args.rows:
        for seed in args.seeds:
            with tempfile.TemporaryDirectory() as folder:
                set_up(args, row, Path(folder))
                words = [sys.executable, __file__, "--neus", ".", "--data", ".", "--work", str(seed)]
                done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode:
                raise SystemExit(done.stdout + done.stderr)
            found = json.loads(done.stdout.splitlines()[-1])
            cells = [f"{value:.4g}" for value in found.values()]
            if (row, seed) == (args.rows[0], args.seeds[0]):
                print("| | seed | " + " | ".join(found) + " |\n|---|---|" + "---|" * len(found))
            print(f"| {row} | {seed} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
