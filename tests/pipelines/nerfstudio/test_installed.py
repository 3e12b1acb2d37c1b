"""nerfstudio itself, installed beside mplicits by pip's own resolver in an environment of their own."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]


def run(*words: object) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Commands of a fresh environment; ``===`` keeps pip from builds such as ``2.13.0+cpu``, unfit for torchvision."""
    folder = tmp_path_factory.mktemp("host")
    environment, constraints = folder / "environment", folder / "constraints.txt"
    constraints.write_text((ROOT / "constraints.txt").read_text().replace("torch==", "torch===", 1))
    run(sys.executable, "-m", "venv", environment)
    (tools,) = [*environment.glob("bin"), *environment.glob("Scripts")]
    run(tools / "python", "-m", "pip", "install", "-q", "-c", constraints, f"{ROOT}[nerfstudio]")
    return tools


def test_all_of_opencv_is_of_one_version(tools: Path) -> None:
    lines = run(tools / "python", "-m", "pip", "list", "--format", "freeze").splitlines()
    versions = {line for line in lines if line.startswith("opencv")}
    assert {name.split("==")[1] for name in versions} == {"4.10.0.84"}, versions
    run(tools / "python", "-c", "import cv2; assert cv2.__version__ == '4.10.0'")


def test_training_resumes_and_is_exported(tools: Path, tmp_path: Path) -> None:
    """``ns-train`` on the CPU on a scene of ours, then on from its checkpoint, and the mesh."""
    scene = tmp_path / "scene"
    train = [
        *(tools / "ns-train", "mplicits", "--machine.device-type", "cpu", "--data", scene, "--vis", "tensorboard"),
        *("--output-dir", tmp_path / "runs", "--experiment-name", "scene", "--timestamp", "now"),
        *("--pipeline.datamanager.train-num-rays-per-batch", 64, "--steps-per-save", 30),
        *("--pipeline.model.background-model", "none"),
    ]
    folder, mesh = tmp_path / "runs" / "scene" / "mplicits" / "now", tmp_path / "mesh.ply"
    run(tools / "mplicits", "scene", "painted-sphere", "-o", scene, "--format", "transforms", "--views", 8)
    run(*train, "--max-num-iterations", 61)
    run(*train, "--max-num-iterations", 5, "--load-dir", folder / "nerfstudio_models")
    run(tools / "ns-mplicits-export", "--load-config", folder / "config.yml", "--output-path", mesh, "--resolution", 64)
    assert mesh.stat().st_size > 0
