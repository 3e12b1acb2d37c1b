"""The command line as a user meets it: output, exit codes, and one line for each mistake."""

import importlib.util
import json
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from mplicits.datasets import sample_sphere
from mplicits.neural_fields import MultiscaleSDF, Similarity, save_field
from mplicits.pipelines.cli import doctor
from mplicits.pipelines.cli.entry import COMMANDS, main
from mplicits.pipelines.surface.surface import read_surface

SMALL = ["--widths", "16", "16", "--depths", "1", "1", "--omegas", "5", "8", "--steps", "300", "100"]
SMALL += ["--learning-rates", "5e-3", "1e-3", "--batch", "256", "--samples", "2000", "--quiet"]


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
    assert main(["fit", str(cloud), "-o", str(path), *SMALL]) == 0
    return path


@pytest.fixture
def box(tmp_path) -> Path:
    path = tmp_path / "box.ply"
    trimesh.creation.box((1, 2, 3)).export(path)
    return path


def fails(capsys, *arguments: object) -> str:
    """Run a command that must fail as bad input does → its one line."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    output, error = capsys.readouterr()
    assert output == ""
    lines = error.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("mplicits: error: ")
    return lines[0]


# --- help --------------------------------------------------------------------------------------------


def test_help_names_every_command(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in COMMANDS)
    assert main([]) == 2
    assert main(["--version"]) == 0
    assert re.search(r"^mplicits \d", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_each_command_has_examples_that_parse(capsys, name):
    from mplicits.pipelines.cli.entry import MPLICITS

    assert main([name, "--help"]) == 0
    assert "examples:" in capsys.readouterr().out
    examples = [line.strip() for line in COMMANDS[name].examples.splitlines()]
    assert examples
    for example in examples:
        words = example.split()
        assert words[0] == "mplicits"
        assert words[1] == name
        rest = words[2:]
        parser = MPLICITS.parser(name)
        parser.check_flags(rest)
        parser.parse_args(rest)


def test_neither_help_nor_mistakes_wait_for_torch():
    program = (
        "import sys; from mplicits.pipelines.cli.entry import main; "
        "main(['--help']); main(['fit', '--help']); main(['fti']); main(['fit', 'a', '--ouput', 'b']); "
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, timeout=60)


# --- mistakes ----------------------------------------------------------------------------------------


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
        ("sample gear -o a.ply --noise 0.1mm", "--noise: is of scans, and gear is an exact mesh"),
    ],
)
def test_mistakes_in_the_arguments(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, *arguments.split())
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
    line = fails(capsys, "fit", tmp_path / name, "-o", tmp_path / "run")
    assert name in line
    assert message in line
    assert not (tmp_path / "run").exists()


def test_foreign_and_damaged_fields_are_one_line(capsys, run, tmp_path):
    (tmp_path / "cut.safetensors").write_bytes((run / "field.safetensors").read_bytes()[:500])
    for arguments in (["info"], ["mesh", "-o", tmp_path / "mesh.ply"]):
        assert "cut.safetensors" in fails(capsys, *arguments, tmp_path / "cut.safetensors")
        assert "not a run directory" in fails(capsys, *arguments, tmp_path)
        assert "no such run" in fails(capsys, *arguments, tmp_path / "absent.safetensors")
    assert not (tmp_path / "mesh.ply").exists()


# --- fit, mesh, evaluate, info -----------------------------------------------------------------------


def test_a_run_is_not_overwritten_unless_told_to(capsys, cloud, run):
    before = (run / "field.safetensors").read_bytes()
    assert "--force overwrites it" in fails(capsys, "fit", cloud, "-o", run, *SMALL)
    assert "nothing to resume" in fails(capsys, "fit", cloud, "-o", run, "--resume")
    assert "is a file" in fails(capsys, "fit", cloud, "-o", run / "run.json", *SMALL)
    assert (run / "field.safetensors").read_bytes() == before


def test_ctrl_c_leaves_a_run_that_resume_finishes(cloud, tmp_path):
    out = tmp_path / "run"
    slow = [word for word in SMALL if word != "--quiet"]
    slow[slow.index("300")] = "100000"
    program = "import sys; from mplicits.pipelines.cli.entry import main; sys.exit(main(sys.argv[1:]))"
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
    done = subprocess.run([*arguments, "--resume"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "run.json").read_text())["finished"]


def test_force_forgets_the_texture_of_the_old_run(capsys, cloud, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "texture.safetensors").write_bytes(b"of the field that is replaced")
    assert "exists and is not empty" in fails(capsys, "fit", cloud, "-o", run, *SMALL)
    assert (run / "texture.safetensors").exists()
    assert main(["fit", str(cloud), "-o", str(run), "--force", "--quiet", *SMALL]) == 0
    assert sorted(path.name for path in run.iterdir() if path.name != "run.lock") == [
        "field.safetensors",
        "run.json",
        "support.safetensors",
    ]


def test_mesh_is_in_input_coordinates_and_evaluate_measures_it(capsys, run, tmp_path):
    out = tmp_path / "ball.ply"
    assert main(["mesh", str(run), "-o", str(out), "--resolution", "48", "--keep-largest"]) == 0
    assert "faces" in capsys.readouterr().out
    truth = tmp_path / "truth.ply"
    trimesh.creation.icosphere(4, radius=3.0).apply_translation((100, 0, 0)).export(truth)
    figures = tmp_path / "figures.json"
    assert main(["evaluate", str(out), str(truth), "--samples", "5000", "--json", str(figures)]) == 0
    written = json.loads(figures.read_text())
    assert written["iou"] > 0.8
    assert written["components"] == 1
    assert f"{written['chamfer']:.3e}" in capsys.readouterr().out


def test_a_glb_is_in_metres_and_at_the_origin_and_says_what_it_took_for_granted(capsys, run, tmp_path):
    plain, placed = tmp_path / "plain.glb", tmp_path / "placed.glb"
    assert main(["mesh", str(run), "-o", str(plain), "--resolution", "24"]) == 0
    assert "one input unit is taken for 1 m (--unit says what it is)" in capsys.readouterr().out
    flags = ["--up", "z", "--unit", "cm", "--center"]
    assert main(["mesh", str(run), "-o", str(placed), "--resolution", "24", *flags]) == 0
    assert "y up, in m (1 input unit = 0.01 m), centred at the origin" in capsys.readouterr().out
    before, after = trimesh.load_mesh(plain), trimesh.load_mesh(placed)
    np.testing.assert_allclose(before.bounds.mean(axis=0), [100, 0, 0], atol=0.3)
    np.testing.assert_allclose(after.extents, before.extents[[0, 2, 1]] / 100, rtol=1e-5)
    assert np.abs(after.bounds.sum(axis=0)).max() < 1e-6
    np.testing.assert_allclose(read_surface(placed).vertices, read_surface(plain).vertices, atol=1e-5)


def test_a_mesh_with_fewer_triangles_says_how_far_it_is_from_the_full_one(capsys, run, tmp_path):
    pytest.importorskip("fast_simplification", reason="the extra mplicits[texture] is not installed")
    out, figures = tmp_path / "small.ply", tmp_path / "small.json"
    flags = ["--resolution", "48", "--faces", "500", "--unit", "cm", "--json", str(figures)]
    assert main(["mesh", str(run), "-o", str(out), *flags]) == 0
    text = capsys.readouterr().out
    cost = json.loads(figures.read_text())["decimation"]
    assert cost["faces"] == len(trimesh.load_mesh(out).faces) <= 500
    assert f"{cost['faces_before']:,} → {cost['faces']:,} faces, at most {cost['largest']:.3g} cm" in text
    assert 0 < cost["mean"] < cost["largest"] < 1  # of a ball of radius 3
    assert "still watertight" in text
    normals = np.stack(
        [trimesh.load_mesh(out, process=False).metadata["_ply_raw"]["vertex"]["data"][n] for n in ("nx", "ny", "nz")]
    )
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-6)
    assert "--texture-faces" in fails(
        capsys, "mesh", run, "-o", tmp_path / "a.glb", "--texture", "64", "--faces", "500"
    )
    assert "--texture" in fails(capsys, "mesh", run, "-o", tmp_path / "a.glb", "--texture", "64", "--report")


def test_an_stl_comes_with_what_a_printer_asks(capsys, run, tmp_path):
    out, figures = tmp_path / "print.stl", tmp_path / "print.json"
    flags = ["--resolution", "48", "--keep-largest", "--up", "z", "--unit", "cm", "--center"]
    assert main(["mesh", str(run), "-o", str(out), *flags, "--json", str(figures)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"watertight +yes", text)
    found = json.loads(figures.read_text())["printing"]
    mesh = trimesh.load_mesh(out)  # in millimetres
    assert found["unit"] == "mm"
    assert found["parts"] == 1
    assert found["volume"] == pytest.approx(mesh.volume, rel=1e-5)
    np.testing.assert_allclose(found["size"], mesh.extents, rtol=1e-5)
    assert found["thinnest"] == pytest.approx(60, rel=0.1)  # a ball of radius 3 cm, fitted in a moment
    assert main(["mesh", str(run), "-o", str(out), "--resolution", "24", "--no-report"]) == 0
    assert "watertight" not in capsys.readouterr().out
    assert main(["mesh", str(run), "-o", str(tmp_path / "a.ply"), "--resolution", "24"]) == 0
    assert "watertight" not in capsys.readouterr().out


def test_levels_are_meshed_by_number(capsys, run, tmp_path):
    assert main(["mesh", str(run), "-o", str(tmp_path / "a.stl"), "--resolution", "32", "--level", "0"]) == 0
    assert "has levels 0 to 1" in fails(capsys, "mesh", run, "-o", tmp_path / "b.stl", "--level", "2")
    plain, mapped = str(tmp_path / "c.ply"), str(tmp_path / "d.ply")
    assert main(["mesh", str(run), "-o", plain, "--resolution", "24", "--level", "0"]) == 0
    assert main(["mesh", str(run), "-o", mapped, "--resolution", "24", "--level", "0", "--normal-level", "1"]) == 0
    plain, mapped = (
        trimesh.load_mesh(path, process=False).metadata["_ply_raw"]["vertex"]["data"] for path in (plain, mapped)
    )
    np.testing.assert_array_equal(plain["x"], mapped["x"])
    assert 1e-4 < np.abs(plain["nx"] - mapped["nx"]).max() < 1
    assert "--normal-level 2" in fails(capsys, "mesh", run, "-o", tmp_path / "b.stl", "--normal-level", "2")


def test_trimming_takes_the_points_from_the_fit_or_from_a_file(capsys, run, cloud, tmp_path):
    out = str(tmp_path / "a.ply")
    assert main(["mesh", str(run), "-o", out, "--resolution", "32", "--trim-distance", "1"]) == 0
    half = tmp_path / "half.xyz"
    points = np.loadtxt(cloud)
    np.savetxt(half, points[points[:, 0] > 100])
    whole = trimesh.load_mesh(out).area
    arguments = ["mesh", str(run), "-o", out, "--resolution", "32", "--trim-distance", "0.6", "--cloud", str(half)]
    assert main(arguments) == 0
    assert trimesh.load_mesh(out).area == pytest.approx(whole * 0.6, rel=0.2)


def test_a_field_without_a_surface_says_so(capsys, tmp_path):
    field = MultiscaleSDF.from_widths([(8, 1)], omegas=[30])
    state = {name: tensor * 0 for name, tensor in field.state_dict().items()}
    last = [name for name in state if name.endswith("bias")][-1]
    state[last] += 1
    field.load_state_dict(state)
    save_field(tmp_path / "one.safetensors", field, similarity=Similarity.identity())
    line = fails(capsys, "mesh", tmp_path / "one.safetensors", "-o", tmp_path / "mesh.ply")
    assert "no surface" in line
    assert not (tmp_path / "mesh.ply").exists()


def test_info_describes_runs_fields_meshes_and_clouds(capsys, run, cloud, box):
    assert main(["info", str(run)]) == 0
    text = capsys.readouterr().out
    assert "MultiscaleSDF, 2 levels" in text
    assert "(16, 1), ω₀ = 5" in text
    assert "δ = " in text
    assert "finished" in text
    assert main(["info", str(run / "field.safetensors")]) == 0
    assert "2 levels" in capsys.readouterr().out
    assert main(["info", str(box)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"vertices, faces +8, 12", text)
    assert re.search(r"closed +yes", text)
    assert main(["info", str(cloud)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"points +3,000", text)
    assert re.search(r"normals +yes", text)


def test_ctrl_c_and_a_closed_pipe_end_quietly(monkeypatch, capsys):
    def interrupt(_path: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("mplicits.pipelines.cli.entry.describe", interrupt)
    assert main(["info", "x"]) == 130
    assert capsys.readouterr().err == "mplicits: interrupted\n"


def test_output_into_a_closed_pipe_is_no_traceback(box):
    program = f"import sys; from mplicits.pipelines.cli.entry import main; sys.exit(main(['info', {str(box)!r}]))"
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
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
    words = "--noise 0.48 --isotropic-noise 960um --quantise 0.048cm --misalign 0 --smear 0.25 --uneven 3"
    assert main(["sample", "-o", str(tmp_path / "scan.ply"), *words.split()]) == 0
    assert asked["noise"] == pytest.approx(1e-3)  # the statue's unit is 480 mm
    faults = asked["faults"]
    assert (faults.isotropic, faults.quantise) == pytest.approx((2e-3, 1e-3))
    assert (faults.misalign, faults.smear, faults.uneven) == (0, 0.25, 3)


def test_the_demo_writes_meshes_and_a_picture_of_any_cloud(cloud, tmp_path, capsys):
    out = tmp_path / "demo"
    small = [*(word for word in SMALL if word != "--quiet"), "--resolution", "48"]
    assert main(["demo", str(cloud), "-o", str(out), *small]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["mesh.glb", "mesh.ply", "picture.png", "run"]
    mesh = trimesh.load_mesh(out / "mesh.ply")
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [100, 0, 0], atol=0.3)
    middle = mesh.bounds.mean(axis=0)  # the GLB is for other programs: at the origin, in its scene
    np.testing.assert_allclose(trimesh.load_mesh(out / "mesh.glb").bounds, mesh.bounds - middle, atol=1e-3)
    np.testing.assert_allclose(read_surface(out / "mesh.glb").vertices, mesh.vertices, atol=1e-4)
    text = capsys.readouterr().out
    assert re.search(r"level 1 +\d", text)
    assert "is a file" in fails(capsys, "demo", cloud, "-o", out / "mesh.ply")


# --- doctor ------------------------------------------------------------------------------------------


def test_doctor_finds_nothing_wrong_here(capsys):
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "GFLOP/s" in text
    assert re.search(r"ok +torch +\d", text)
    assert "error" not in text.replace("errors", "")


def test_doctor_says_that_nothing_is_kept_of_what_python_compiles(monkeypatch, tmp_path):
    monkeypatch.setattr(torch, "__file__", str(tmp_path / "it's" / "torch" / "__init__.py"))
    kept = Path(importlib.util.cache_from_source(torch.__file__))
    (start,) = [finding for finding in doctor.examine(tmp_path) if finding.topic == "start"]
    assert start.level == "warning"
    assert str(kept) in start.text
    kept.parent.mkdir(parents=True)
    Path(torch.__file__).touch()
    words = shlex.split(start.text.partition("; ")[2].partition(", and")[0])
    assert words[0] == sys.executable  # another Python keeps other files
    subprocess.run(words, check=True)
    assert kept.exists()
    (start,) = [finding for finding in doctor.examine(tmp_path) if finding.topic == "start"]
    assert start.level == "ok"


def test_doctor_says_who_evaluates(monkeypatch, tmp_path):
    monkeypatch.setenv("MPLICITS_KERNELS", "off")
    (kernels,) = [finding for finding in doctor.examine(tmp_path) if finding.topic == "kernels"]
    assert (kernels.level, kernels.text) == ("note", "PyTorch evaluates all networks (MPLICITS_KERNELS=off)")
    monkeypatch.setenv("MPLICITS_KERNELS", "on")
    (kernels,) = [finding for finding in doctor.examine(tmp_path) if finding.topic == "kernels"]
    assert kernels.level == "warning"
    assert "expected one of auto, off" in kernels.text


def test_doctor_knows_all_extras(monkeypatch, tmp_path):
    """As installers write them into the metadata, from pyproject.toml."""
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [f'{line}; extra == "{extra}"' for extra, wanted in extras.items() for line in wanted]
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: [*project["dependencies"], *lines])
    monkeypatch.setattr(doctor, "_installed", lambda name: None)
    report = doctor.format_findings(doctor.examine(tmp_path))
    for extra in ("las", "poisson", "texture"):
        assert f"optional, not installed; pip install 'mplicits[{extra}]'" in report
    assert "mplicits[dev]" not in report
    assert "xatlas" in report


def test_doctor_tells_two_builds_of_torch_apart(monkeypatch, tmp_path):
    """As torchvision does where torch came without CUDA and torchvision with it."""
    package = tmp_path / "torchvision.py"
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(doctor, "_installed", {"torchvision": "0.28.0"}.get)
    package.write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    (found,) = doctor._torchvision()
    assert (found.level, found.topic) == ("warning", "torchvision")
    assert f"does not work with torch {torch.__version__} (RuntimeError: operator torchvision::nms" in found.text
    package.write_text("")
    (found,) = doctor._torchvision()
    assert found.level == "ok"
    monkeypatch.setattr(doctor, "_installed", lambda name: None)
    assert doctor._torchvision() == []


def test_doctor_names_what_is_missing_and_what_clashes(monkeypatch, tmp_path):
    versions = {"torch": "2.1.0", "opencv-contrib-python-headless": "5.0.0", "opencv-python": "4.9"}
    monkeypatch.setattr(doctor, "_installed", versions.get)
    findings = {finding.topic: finding for finding in doctor.examine(tmp_path / "absent")}
    assert findings["torch"].level == "error"
    assert "2.1.0 is too old; pip install 'torch>=2.6'" in findings["torch"].text
    assert "not installed; pip install 'numpy>=" in findings["numpy"].text
    assert findings["laspy"].level == "note"
    assert "pip install 'mplicits[las]'" in findings["laspy"].text
    assert findings["cv2"].level == "warning"
    assert "opencv-python" in findings["cv2"].text
    assert findings["disk"].level == "error"
    assert "errors: see above" in doctor.format_findings(list(findings.values()))
