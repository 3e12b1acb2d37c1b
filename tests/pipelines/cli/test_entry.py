"""The command line as a user meets it: output, exit codes, and one line for each mistake."""

import json
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from evolutions import fails
from mplicits.datasets import read_cloud, sample_sphere
from mplicits.neural_fields import Sphere, save_field
from mplicits.pipelines.cli import doctor
from mplicits.pipelines.cli.entry import COMMANDS, MPLICITS, main
from mplicits.pipelines.surface.surface import read_surface

SMALL = "--widths 16 16 --depths 1 1 --omegas 5 8 --steps 300 100 --learning-rates 5e-3 1e-3 --batch 256 --samples 2000"


IMPORT_MAIN = "import sys; from mplicits.pipelines.cli.entry import main"


@pytest.fixture(scope="module")
def cloud(tmp_path_factory) -> Path:
    """A sphere of radius 3 around (100, 0, 0), as text with normals."""
    normals = np.random.default_rng(0).normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path = tmp_path_factory.mktemp("cloud") / "ball.xyz"
    np.savetxt(path, np.concatenate((3 * normals + [100, 0, 0], normals), axis=1))
    return path


@pytest.fixture(scope="module")
def run(cloud, tmp_path_factory) -> Path:
    """A finished run, fitted through the command line."""
    path = tmp_path_factory.mktemp("runs") / "ball"
    assert main(f"fit {cloud} -o {path} {SMALL} --quiet".split()) == 0
    return path


@pytest.fixture
def box(tmp_path) -> Path:
    path = tmp_path / "box.ply"
    trimesh.creation.box((1, 2, 3)).export(path)
    return path


def said(capsys, line: str) -> str:
    """Run a command → what it prints."""
    capsys.readouterr()
    assert main(line.split()) == 0
    return capsys.readouterr().out


def test_help_names_every_command(capsys):
    text = said(capsys, "--help")
    assert all(f"  {name} " in text for name in COMMANDS)
    assert main([]) == 2
    assert re.search(r"^mplicits \d", said(capsys, "--version"), re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_each_command_has_examples_that_parse(capsys, name):
    assert "examples:" in said(capsys, f"{name} --help")
    examples = COMMANDS[name].examples.splitlines()
    assert examples
    for example in examples:
        program, command, *rest = example.split()
        assert (program, command) == ("mplicits", name)
        parser = MPLICITS.parser(name)
        parser.check_flags(rest)
        parser.parse_args(rest)


def test_neither_help_nor_mistakes_wait_for_torch():
    lines = [["--help"], ["fit", "--help"], ["fti"], ["fit", "a", "--ouput", "b"]]
    program = f"{IMPORT_MAIN}; [main(line) for line in {lines}]; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, timeout=60)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("mseh", "unknown command 'mseh'; did you mean 'mesh'?"),
        ("fit a.ply --ouput b", "unknown flag --ouput; did you mean '--out'?"),
        ("fit a.ply", "the following arguments are required: -o/--out"),
        ("fit a.ply -o b --preset fsat", "no preset 'fsat' for fit; did you mean 'fast'?"),
        ("fit a.ply -o b --steps many", "--steps: got 'many', expected a list of whole numbers"),
        ("fit a.ply -o b --resume --seed 3", "--resume: continues with the run's own settings"),
        ("mesh run -o mesh.xyz", "mesh.xyz: unknown mesh format '.xyz'"),
        ("mesh run -o absent/mesh.ply", "run: no such run directory"),
        ("evaluate a.ply b.ply --json figures.txt", "figures.txt: unknown extension '.txt'"),
        ("sample -o a.ply --noise much", "--noise much: expected a number of input units, or one with a unit"),
        ("sample -o a.ply --misalign -1mm", "--misalign -1mm: expected a length ≥ 0"),
        ("sample -o a.ply --smear 2", "--smear: got '2', expected a number from 0 to 1"),
    ],
)
def test_mistakes_in_the_arguments(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.ply", None, "no such file"),
        ("cut.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 50\n", "cut.ply"),
        ("scan.docx", b"PK", "unknown extension"),
        ("nan.xyz", b"nan nan nan\n" * 20, "none with finite coordinates"),
        ("point.xyz", b"1 2 3\n" * 20, "coincide"),
    ],
)
def test_broken_clouds_are_one_line_and_leave_no_run_behind(capsys, tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    line = fails(capsys, f"fit {tmp_path / name} -o {tmp_path}/run")
    assert name in line
    assert message in line
    assert not (tmp_path / "run").exists()


def test_foreign_and_damaged_fields_are_one_line(capsys, run, tmp_path):
    (tmp_path / "cut.safetensors").write_bytes((run / "field.safetensors").read_bytes()[:500])
    save_field(tmp_path / "far.safetensors", Sphere(center=(9.0, 0.0, 0.0)))
    mesh = f"mesh -o {tmp_path}/mesh.ply"
    for command in ("info", mesh):
        assert "cut.safetensors" in fails(capsys, f"{command} {tmp_path}/cut.safetensors")
        assert "not a run directory" in fails(capsys, f"{command} {tmp_path}")
        assert "no such run" in fails(capsys, f"{command} {tmp_path}/absent.safetensors")
    assert "no surface" in fails(capsys, f"{mesh} {tmp_path}/far.safetensors")
    assert not (tmp_path / "mesh.ply").exists()


def test_a_run_is_not_overwritten_unless_told_to(capsys, cloud, run):
    before = (run / "field.safetensors").read_bytes()
    assert "--force" in fails(capsys, f"fit {cloud} -o {run} {SMALL}")
    assert "nothing to resume" in fails(capsys, f"fit {cloud} -o {run} --resume")
    assert "is a file" in fails(capsys, f"fit {cloud} -o {run}/run.json {SMALL}")
    assert (run / "field.safetensors").read_bytes() == before


def test_ctrl_c_leaves_a_run_that_resume_finishes(cloud, tmp_path):
    out = tmp_path / "run"
    slow = SMALL.replace("300", "100000").split()
    program = f"{IMPORT_MAIN}; sys.exit(main(sys.argv[1:]))"
    arguments = [sys.executable, "-c", program, "fit", str(cloud), "-o", str(out)]
    process = subprocess.Popen([*arguments, *slow], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 600  # of a busy machine
    while not (out / "run.lock").is_file() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=600)
    assert process.returncode == 130, error
    assert f"to continue: mplicits fit {cloud} -o {out} --resume" in error
    assert "Traceback" not in error
    record = json.loads((out / "run.json").read_text())
    record["config"]["time_budget"] = 1.0  # or its 100,000 steps would go on for hours
    (out / "run.json").write_text(json.dumps(record))
    done = subprocess.run([*arguments, "--resume"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "run.json").read_text())["finished"]


def test_force_forgets_the_texture_of_the_old_run(capsys, cloud, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "texture.safetensors").write_bytes(b"of the field that is replaced")
    assert "exists and is not empty" in fails(capsys, f"fit {cloud} -o {run} {SMALL}")
    assert (run / "texture.safetensors").exists()
    assert main(f"fit {cloud} -o {run} --force --quiet {SMALL}".split()) == 0
    assert (run / "field.safetensors").exists()
    assert not (run / "texture.safetensors").exists()


def test_mesh_is_in_input_coordinates_and_evaluate_measures_it(capsys, run, tmp_path):
    out, truth, figures = (tmp_path / name for name in ("ball.ply", "truth.ply", "figures.json"))
    assert "faces" in said(capsys, f"mesh {run} -o {out} --resolution 48 --keep-largest")
    trimesh.creation.icosphere(4, radius=3.0).apply_translation((100, 0, 0)).export(truth)
    text = said(capsys, f"evaluate {out} {truth} --samples 5000 --json {figures}")
    written = json.loads(figures.read_text())
    assert written["iou"] > 0.8
    assert written["components"] == 1
    assert f"{written['chamfer']:.3e}" in text


def test_a_glb_is_in_metres_and_at_the_origin_and_says_what_it_took_for_granted(capsys, run, tmp_path):
    plain, placed = tmp_path / "plain.glb", tmp_path / "placed.glb"
    assert "is taken for 1 m" in said(capsys, f"mesh {run} -o {plain} --resolution 24")
    text = said(capsys, f"mesh {run} -o {placed} --resolution 24 --up z --unit cm --center")
    assert "y up, in m (1 input unit = 0.01 m), centred at the origin" in text
    before, after = trimesh.load_mesh(plain), trimesh.load_mesh(placed)
    np.testing.assert_allclose(before.bounds.mean(axis=0), [100, 0, 0], atol=0.3)
    np.testing.assert_allclose(after.extents, before.extents[[0, 2, 1]] / 100, rtol=1e-5)
    assert np.abs(after.bounds.sum(axis=0)).max() < 1e-6
    np.testing.assert_allclose(read_surface(placed).vertices, read_surface(plain).vertices, atol=1e-5)


def test_a_mesh_with_fewer_triangles_says_how_far_it_is_from_the_full_one(capsys, run, tmp_path):
    pytest.importorskip("fast_simplification", reason="the extra mplicits[texture] is not installed")
    out, figures = tmp_path / "small.ply", tmp_path / "small.json"
    text = said(capsys, f"mesh {run} -o {out} --resolution 48 --faces 500 --unit cm --json {figures}")
    cost = json.loads(figures.read_text())["decimation"]
    assert cost["faces"] == len(trimesh.load_mesh(out).faces) <= 500
    assert f"at most {cost['largest']:.3g} cm" in text
    assert 0 < cost["mean"] < cost["largest"] < 1  # of a ball of radius 3
    np.testing.assert_allclose(np.linalg.norm(read_cloud(out).normals, axis=1), 1, atol=1e-6)
    assert "--texture-faces" in fails(capsys, f"mesh {run} -o {tmp_path}/a.glb --texture 64 --faces 500")
    assert "--texture" in fails(capsys, f"mesh {run} -o {tmp_path}/a.glb --texture 64 --report")


def test_an_stl_comes_with_what_a_printer_asks(capsys, run, tmp_path):
    out, figures = tmp_path / "print.stl", tmp_path / "print.json"
    flags = f"--resolution 48 --keep-largest --up z --unit cm --center --json {figures}"
    assert re.search(r"watertight +yes", said(capsys, f"mesh {run} -o {out} {flags}"))
    found = json.loads(figures.read_text())["printing"]
    mesh = trimesh.load_mesh(out)  # in millimetres
    assert (found["unit"], found["parts"]) == ("mm", 1)
    assert found["volume"] == pytest.approx(mesh.volume, rel=1e-5)
    np.testing.assert_allclose(found["size"], mesh.extents, rtol=1e-5)
    assert found["thinnest"] == pytest.approx(60, rel=0.1)  # a ball of radius 3 cm, fitted in a moment
    assert "watertight" not in said(capsys, f"mesh {run} -o {out} --resolution 24 --no-report")
    assert "watertight" not in said(capsys, f"mesh {run} -o {tmp_path}/a.ply --resolution 24")


def test_levels_are_meshed_by_number(capsys, run, tmp_path):
    assert "has levels 0 to 1" in fails(capsys, f"mesh {run} -o {tmp_path}/b.stl --level 2")
    assert "--normal-level 2" in fails(capsys, f"mesh {run} -o {tmp_path}/b.stl --normal-level 2")
    for name, flags in (("plain", ""), ("mapped", "--normal-level 1")):
        said(capsys, f"mesh {run} -o {tmp_path}/{name}.ply --resolution 24 --level 0 {flags}")
    plain, mapped = (read_cloud(tmp_path / f"{name}.ply") for name in ("plain", "mapped"))
    np.testing.assert_array_equal(plain.points, mapped.points)
    assert 1e-4 < np.abs(plain.normals - mapped.normals).max() < 1


def test_trimming_takes_the_points_from_the_fit_or_from_a_file(capsys, run, cloud, tmp_path):
    out, half = tmp_path / "a.ply", tmp_path / "half.xyz"
    said(capsys, f"mesh {run} -o {out} --resolution 32 --trim-distance 1")
    points = np.loadtxt(cloud)
    np.savetxt(half, points[points[:, 0] > 100])
    whole = trimesh.load_mesh(out).area
    said(capsys, f"mesh {run} -o {out} --resolution 32 --trim-distance 0.6 --cloud {half}")
    assert trimesh.load_mesh(out).area == pytest.approx(whole * 0.6, rel=0.2)


def test_info_describes_runs_fields_meshes_and_clouds(capsys, run, cloud, box):
    for source, lines in (
        (run, ["MultiscaleSDF, 2 levels", r"\(16, 1\), ω₀ = 5", "δ = ", "finished"]),
        (run / "field.safetensors", ["2 levels"]),
        (box, [r"vertices, faces +8, 12", r"closed +yes"]),
        (cloud, [r"points +3,000", r"normals +yes"]),
    ):
        text = said(capsys, f"info {source}")
        assert all(re.search(line, text) for line in lines), text


def test_ctrl_c_ends_quietly(monkeypatch, capsys):
    def interrupt(_path: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("mplicits.pipelines.cli.entry.describe", interrupt)
    assert main(["info", "x"]) == 130
    assert capsys.readouterr().err == "mplicits: interrupted\n"


def test_output_into_a_closed_pipe_is_no_traceback(box):
    program = f"{IMPORT_MAIN}; sys.exit(main(['info', {str(box)!r}]))"
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    error = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=60) == 141
    assert error == b""


def test_the_faults_of_the_sample_are_lengths_of_its_millimetres(monkeypatch, tmp_path):
    asked = {}

    def scan(*, seed, progress, **options):
        asked.update(options)
        return sample_sphere(50, seed=seed)

    monkeypatch.setattr("mplicits.datasets.statue_scan", scan)
    flags = "--noise 0.48 --isotropic-noise 960um --quantise 0.048cm --misalign 0 --smear 0.25 --uneven 3"
    assert main(f"sample -o {tmp_path}/scan.ply {flags}".split()) == 0
    assert asked["noise"] == pytest.approx(1e-3)  # the statue's unit is 480 mm
    faults = asked["faults"]
    assert (faults.isotropic, faults.quantise) == pytest.approx((2e-3, 1e-3))
    assert (faults.misalign, faults.smear, faults.uneven) == (0, 0.25, 3)


def test_the_demo_writes_meshes_and_a_picture_of_any_cloud(cloud, tmp_path, capsys):
    out = tmp_path / "demo"
    assert re.search(r"level 1 +\(16, 1\)", said(capsys, f"demo {cloud} -o {out} {SMALL} --resolution 48"))
    assert sorted(path.name for path in out.iterdir()) == ["mesh.glb", "mesh.ply", "picture.png", "run"]
    mesh = trimesh.load_mesh(out / "mesh.ply")
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [100, 0, 0], atol=0.3)
    middle = mesh.bounds.mean(axis=0)  # the GLB is for other programs: at the origin, in its scene
    np.testing.assert_allclose(trimesh.load_mesh(out / "mesh.glb").bounds, mesh.bounds - middle, atol=1e-3)
    np.testing.assert_allclose(read_surface(out / "mesh.glb").vertices, mesh.vertices, atol=1e-4)
    assert "is a file" in fails(capsys, f"demo {cloud} -o {out}/mesh.ply")


def test_doctor_finds_nothing_wrong_here(capsys):
    text = said(capsys, "doctor")
    assert "GFLOP/s" in text
    assert re.search(r"ok +torch +\d", text)
    assert "error" not in text.replace("errors", "")


def test_doctor_says_who_evaluates(monkeypatch):
    for setting, level in (("off", "note"), ("on", "warning")):
        monkeypatch.setenv("MPLICITS_KERNELS", setting)
        (kernels,) = [finding for finding in doctor.examine() if finding.topic == "kernels"]
        assert kernels.level == level
        assert "MPLICITS_KERNELS" in kernels.text


def test_doctor_knows_all_extras(monkeypatch):
    """As installers write them into the metadata, from pyproject.toml."""
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [f'{line}; extra == "{extra}"' for extra, wanted in extras.items() for line in wanted]
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: [*project["dependencies"], *lines])
    monkeypatch.setattr(doctor, "_installed", lambda name: None)
    report = doctor.format_findings(doctor.examine())
    assert {"las", "poisson", "texture"} <= set(re.findall(r"mplicits\[(\w+)\]", report)) <= set(extras) - {"dev"}


def test_doctor_names_what_is_missing_and_what_clashes(monkeypatch):
    versions = {"torch": "2.1.0", "opencv-contrib-python-headless": "5.0.0", "opencv-python": "4.9"}
    monkeypatch.setattr(doctor, "_installed", versions.get)
    findings = {finding.topic: finding for finding in doctor.examine()}
    for topic, level, words in (
        ("torch", "error", "2.1.0 is too old; pip install 'torch>="),
        ("numpy", "error", "pip install 'numpy>="),
        ("laspy", "note", "pip install 'mplicits[las]'"),
        ("cv2", "warning", "opencv-python"),
    ):
        assert findings[topic].level == level
        assert words in findings[topic].text
    assert "errors" in doctor.format_findings(list(findings.values()))
