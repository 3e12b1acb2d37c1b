"""Solids on the command line: balls in millimetres, against their volumes and radii."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from evolutions import fails
from mplicits import neural_fields
from mplicits.neural_fields import Box, Mesh, Similarity, Sphere, Union, extract_mesh, load_field, save_field
from mplicits.neural_fields.shape import in_one_frame
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.mesh import solids
from mplicits.pipelines.surface.distance import MeshField
from mplicits.pipelines.surface.surface import Support
from mplicits.pipelines.training.trainer import parameter_count

RADIUS, OTHER, APART = 30.0, 25.0, 35.0  # millimetres
RESOLUTION = 32
AT = np.array([100.0, -50.0, 20.0])


def ball(path: Path, radius: float, offset: float = 0.0) -> Path:
    """A checkpoint of a ball, in a unit sphere of its own."""
    x, y, z = AT + np.array([offset, 0, 0])
    save_field(path, Sphere(radius=0.8), similarity=Similarity((x, y, z), radius / 0.8))
    return path


@pytest.fixture
def balls(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    ball(Path("a.safetensors"), RADIUS)
    ball(Path("b.safetensors"), OTHER, APART)
    return tmp_path


def run(line: str) -> None:
    assert main(line.split()) == 0


def volume_of_lens() -> float:
    near = (APART**2 + RADIUS**2 - OTHER**2) / (2 * APART)
    caps = ((RADIUS, RADIUS - near), (OTHER, OTHER - (APART - near)))
    return sum(math.pi * height**2 * (3 * radius - height) / 3 for radius, height in caps)


A, B = 4 / 3 * math.pi * RADIUS**3, 4 / 3 * math.pi * OTHER**3


@pytest.mark.parametrize(
    ("operation", "exact"),
    [("union", A + B - volume_of_lens()), ("intersection", volume_of_lens()), ("difference", A - volume_of_lens())],
)
def test_two_balls(balls: Path, operation: str, exact: float):
    second = "b.safetensors"
    if operation == "difference":
        second = "b.stl"
        run("mesh b.safetensors -o b.stl --resolution 96")
    run(f"boolean a.safetensors {second} --{operation} -o out.ply --resolution {RESOLUTION}")
    mesh = trimesh.load_mesh("out.ply")
    assert mesh.is_watertight
    # Of the frame around both: cells of 2.14 scales / resolution; see test_algebra.test_volumes_of_two_balls.
    step = 2.14 * 0.5 * (2 * (RADIUS + OTHER) / 1.6 + APART) / RESOLUTION
    near = (APART**2 + RADIUS**2 - OTHER**2) / (2 * APART)
    rim = 2 * math.pi * math.sqrt(RADIUS**2 - near**2)
    allowed = 4 * math.pi * (RADIUS**2 + OTHER**2) * 3 * step**2 / (8 * OTHER) + 3 * rim * step**2
    assert abs(mesh.volume - exact) < allowed
    assert abs(A + B - volume_of_lens() - A) > 2 * allowed  # the operations differ by more


def test_a_field_of_two_runs_is_meshed_later(balls: Path, capsys):
    assert (
        main(["boolean", "a.safetensors", "b.safetensors", "--union", "--smooth", "4", "-o", "both.safetensors"]) == 0
    )
    saved = load_field("both.safetensors")
    assert isinstance(saved.field, Union)
    assert abs(saved.field.smooth * saved.similarity.scale - 4) < 1e-9
    assert parameter_count(saved.field) == 0
    assert "closed, volume" in capsys.readouterr().out
    run("mesh both.safetensors -o both.ply --resolution 48")
    run("info both.safetensors")
    assert "Union" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("by", "flags"), [("2mm", "--unit mm"), ("0.2cm", "--unit mm"), ("2", ""), ("-2mm", "--unit mm")]
)
@pytest.mark.parametrize("source", ["a.safetensors", "a.stl"])
def test_a_ball_is_grown_and_shrunk(balls: Path, by: str, flags: str, source: str):
    run(f"mesh a.safetensors -o a.stl --resolution {RESOLUTION}")
    run(f"offset {source} --by {by} -o out.ply --resolution {RESOLUTION} {flags}")
    mesh = trimesh.load_mesh("out.ply")
    if flags:  # PLY is in metres where the unit is known
        mesh.apply_scale(1000)
    assert mesh.is_watertight
    expected = RADIUS - 2 if by.startswith("-") else RADIUS + 2
    # The distance is that to a mesh, which is nearer to the centre by up to the chord of a cell: 3 h² / (8 r).
    step = 2.14 * (RADIUS / 0.8) / RESOLUTION
    chord = 3 * step**2 / (8 * RADIUS)
    radii = np.linalg.norm(mesh.vertices - AT, axis=1)
    assert expected - 2 * chord < radii.min()
    assert radii.max() < expected + chord / 4


@pytest.mark.parametrize(("by", "inner", "outer"), [("-5", RADIUS - 5, RADIUS), ("5", RADIUS, RADIUS + 5)])
def test_a_hollow_ball(balls: Path, by: str, inner: float, outer: float):
    run(f"offset a.safetensors --by {by} --shell -o out.stl --resolution 40")
    mesh = trimesh.load_mesh("out.stl")
    assert mesh.is_watertight
    assert mesh.body_count == 2  # the wall's two sides
    step = 2.14 * (RADIUS / 0.8 + 5) / 40
    exact = 4 / 3 * math.pi * (outer**3 - inner**3)
    assert abs(mesh.volume - exact) < 2 * 4 * math.pi * (outer**2 + inner**2) * 3 * step**2 / (8 * inner)


def test_a_mesh_is_an_exact_distance():
    box = trimesh.creation.box((1.0, 0.6, 0.8))
    surface = Mesh(np.asarray(box.vertices), np.asarray(box.faces)[:, ::-1].astype(np.int64))  # inside out
    field, exact = MeshField(surface), Box(half_size=(0.5, 0.3, 0.4))
    x = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
    torch.testing.assert_close(field.jet(x)[:2], exact.jet(x)[:2], rtol=0, atol=1e-12)
    assert abs(field.volume - 0.48) < 1e-12
    assert abs(extract_mesh(field, resolution=32).vertices).max() < 0.5 + 1e-6
    on_face = torch.tensor([[0.5, 0.1, 0.1]], dtype=torch.float64)
    assert field.jet(on_face).gradient.tolist() == [[1.0, 0.0, 0.0]]
    with pytest.raises(ValueError, match="not closed"):
        MeshField(Mesh(surface.vertices, surface.faces[1:]))


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [("2mm", "m", 0.002), ("1in", "mm", 25.4), ("-0.5", None, -0.5), ("1e-3m", "mm", 1.0), (" .5 cm", "mm", 5.0)],
)
def test_lengths(text: str, unit: str | None, expected: float):
    assert abs(solids.length_in(text, unit, "--by") - expected) < 1e-12 * abs(expected)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("boolean a.safetensors --union -o o.ply", "expected two"),
        ("boolean a.safetensors b.safetensors -o o.ply", "--union --intersection --difference is required"),
        ("boolean a.safetensors b.safetensors --union -o o.xyz", "unknown mesh format"),
        ("boolean a.safetensors none --union -o o.ply", "none: no such"),
        ("boolean a.safetensors open.ply --union -o o.ply", "open.ply: is not closed"),
        ("boolean a.safetensors box.ply --union -o o.safetensors", "box.ply is a mesh"),
        ("boolean a.safetensors b.safetensors --union --smooth -1 -o o.ply", "--smooth -1: expected a length"),
        ("boolean a.safetensors b.safetensors --union --level 3 -o o.ply", "--level 3: a.safetensors has levels 0"),
        ("boolean a.safetensors far.safetensors --intersection -o o.ply --resolution 16", "nothing is left"),
        ("offset a.safetensors --by 2mm -o o.stl", "how long is a unit of the input? say so with --unit"),
        ("offset a.safetensors --by 2parsec -o o.stl", "--by 2parsec: expected a number of input units"),
        ("offset a.safetensors --by 0 -o o.stl", "--by 0: expected a length other than 0"),
        ("offset a.safetensors --by -40 -o o.stl --resolution 16", "nothing is left"),
        ("offset a.safetensors --by 2 --shell -o o.stl --resolution 40", "of 0.95 cells"),
        ("offset a.safetensors --by -2 --shell -o o.stl --resolution 40", "--resolution 81"),
        ("offset a.safetensors --by 2 --time 0.5 -o o.stl", "does not move"),
    ],
)
def test_one_line_says_what_is_wrong(balls: Path, capsys, words: str, message: str):
    ball(Path("far.safetensors"), RADIUS, 500.0)
    box = trimesh.creation.box((1.0, 0.6, 0.8))
    box.export("box.ply")
    trimesh.Trimesh(box.vertices, box.faces[1:], process=False).export("open.ply")
    assert message in fails(capsys, words)
    assert not Path("o.ply").exists()


def test_blobs_are_not_joined(tmp_path):
    """What no points of a run support is left out of the union, unless the mesh beside it reaches there."""
    scan = neural_fields.WorldField(Union(Sphere(radius=0.4), Sphere(radius=0.15, center=(0.0, 0.0, 0.75))))
    other = neural_fields.WorldField(Sphere(radius=0.2, center=(0.7, 0.0, 0.0)))
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    points *= 0.4 / np.linalg.norm(points, axis=1, keepdims=True)
    operands = [solids.Operand("scan", scan, Support(points, 0.1)), solids.Operand("other", other, None)]
    fields, frame = in_one_frame([scan, other])
    mesh = extract_mesh(Union(*fields), resolution=48)
    heard: list[str] = []
    left = solids._supported(mesh, operands, fields, frame, heard.append)
    assert len(heard) == 1
    assert "removed 1 component " in heard[0]
    assert left.vertices[:, 2].max() < 0.41
    assert left.vertices[:, 0].max() > 0.89
