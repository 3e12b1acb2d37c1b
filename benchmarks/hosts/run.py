"""Trains NeuS or instant-nsr-pl unchanged, and with the lines of docs/drop-in.md; prints costs and errors.

    python -m benchmarks.hosts.run --neus path/to/NeuS --data path/to/dtu_scan24 --steps 240 --rays 64 --seeds 0 1 2

Each run is a copy of the clone in a temporary folder: unchanged (``host``), with the document's lines (``ours``), or
without its other colour network (``ours, 256 features``; ``ours, no encoding``; ``ours, deeper`` has the paper's deeper
levels too). ``--short`` adds NeuS's lines for short trainings to all rows. Without a GPU, ``cuda`` becomes ``cpu``.
NeuS needs ``pip install pyhocon icecream tqdm PyMCubes``, instant-nsr-pl ``omegaconf matplotlib PyMCubes``.

Colours are measured in every eighth view, which is kept from the training, and the mesh against the data's
``surface.ply`` where there is one. ``--keep FILE`` goes on from the rows in a file, and adds to them.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]  # where benchmarks are found from a host's folder
ROWS = {"neus": ("host", "ours", "ours, 256 features", "ours, no encoding", "ours, deeper"), "nsr": ("host", "ours")}


def module(host: str) -> Any:
    """How to set up and train a host; read when it is chosen, as each needs packages of its own."""
    return import_module(f".host_{host}", __package__)


def run(args: argparse.Namespace, host: str, scene: Path, row: str, seed: int) -> dict[str, Any]:
    """One training in a process and a temporary folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        module(host).set_up(args, getattr(args, host), scene, row, Path(folder))
        words = [sys.executable, "-m", __spec__.name, f"--{host}", ".", "--data", scene.resolve(), "--work", seed]
        words = [str(word) for word in words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Train the rows that are not kept yet, and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--neus", type=Path, help="clone of NeuS")
    which.add_argument("--nsr", type=Path, help="clone of instant-nsr-pl")
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="scenes as NeuS wants them: image/, mask/")
    parser.add_argument("--steps", type=int, default=240)
    parser.add_argument("--rays", type=int, default=64, help="per step; NeuS has 512")
    parser.add_argument("--samples", type=int, default=64, help="of a ray, and as many where the surface is; as NeuS")
    parser.add_argument("--warm-up", type=float, default=5000 / 300_000, help="share of the steps; NeuS's by default")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--rows", nargs="+", choices=ROWS["neus"])
    parser.add_argument("--short", action="store_true", help="NeuS: all rows with the lines for short trainings")
    parser.add_argument("--keep", type=Path, help="file of the rows, to go on from")
    parser.add_argument("--work", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    host = "neus" if args.neus else "nsr"
    if args.short and host == "nsr":
        parser.error("--short goes with --neus")
    if args.work is not None:
        print("\n" + json.dumps(module(host).work(args.data[0], args.work)))
        return
    kept = args.keep.read_text().splitlines() if args.keep and args.keep.is_file() else []
    rows = {tuple(key): found for key, found in map(json.loads, kept)}
    for seed, scene, row in product(args.seeds, args.data, args.rows or ROWS[host]):
        key = (host, scene.resolve().name, row, seed, args.steps, args.rays, args.samples, args.warm_up)
        key += ("short",) * args.short
        if key not in rows:
            rows[key] = run(args, host, scene, row, seed)
            if args.keep:
                with args.keep.open("a") as file:
                    file.write(json.dumps([key, rows[key]]) + "\n")
        print(", ".join(map(str, key[:5])), "|", ", ".join(f"{k} {shown(v)}" for k, v in rows[key].items()), flush=True)


def shown(value: Any) -> str:
    """A number in four digits, a course as seconds: error."""
    if isinstance(value, list):
        return " ".join(f"{seconds:.0f} s: {error:.4f}" for seconds, error in value)
    return f"{value:.4g}"


if __name__ == "__main__":
    main()
