"""A surface extracted part by part is the one that is extracted whole, and closed where fields are steep too."""

import numpy as np
import pytest
from closed import assert_closed
from mplicits.neural_fields import FunctionField, Mesh, NoSurfaceError, Sphere, Torus, extract_mesh
from mplicits.neural_fields.meshing.parts import extract_parts


def joined(parts):
    """One mesh of parts, with vertices of the same lattice edge made one; later parts replace earlier ones."""
    last = {part.place: part for part in parts}.values()
    starts = np.cumsum([0, *(len(part.mesh.vertices) for part in last)])
    vertices = np.concatenate([part.mesh.vertices for part in last])
    normals = np.concatenate([part.mesh.normals for part in last])
    faces = np.concatenate([part.mesh.faces + start for part, start in zip(last, starts, strict=False)])
    rows = np.concatenate([part.shared + start for part, start in zip(last, starts, strict=False)])
    edges = np.concatenate([part.border.edges for part in last])
    _, first, place = np.unique(edges, return_index=True, return_inverse=True)
    number = np.arange(len(vertices))
    number[rows] = rows[first[place]]
    assert np.array_equal(vertices, vertices[number])  # to the last bit
    assert np.array_equal(normals, normals[number])
    used, faces = np.unique(number[faces], return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3), normals[used])


def ordered(rows):
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("field", [Sphere(radius=0.5), Torus()], ids=["sphere", "torus"])
@pytest.mark.parametrize(("resolution", "cells"), [(64, 16), (37, 8), (64, 128)])
def test_parts_are_those_of_the_whole(field, resolution, cells):
    whole = extract_mesh(field, resolution=resolution)
    mesh = joined(extract_parts(field, resolution=resolution, cells=cells))
    assert_closed(mesh)
    assert mesh.faces.shape == whole.faces.shape
    # The same lattice points, of which one counts from another corner: coordinates of up to 1.02 round alike.
    assert np.allclose(ordered(mesh.vertices), ordered(whole.vertices), rtol=0, atol=1e-12)


def test_parts_of_a_field_steeper_than_the_bound_are_closed():
    """Bumps on a sphere, of slope up to 5: culling by half misses blocks that only a neighbour's side shows."""
    bumps = FunctionField(lambda x: x.norm(dim=-1) - 0.6 + 0.15 * (30 * x).sin().prod(dim=-1))
    parts = list(extract_parts(bumps, resolution=48, cells=8, lipschitz=0.5))
    assert len(parts) > len({part.place for part in parts}), "no part came again, so this test shows nothing"
    assert_closed(joined(parts))


def test_parts_of_a_surface_that_leaves_the_box_end_there():
    whole = extract_mesh(Sphere(radius=1.2), resolution=40)
    mesh = joined(extract_parts(Sphere(radius=1.2), resolution=40, cells=16))
    assert mesh.faces.shape == whole.faces.shape
    assert np.allclose(ordered(mesh.vertices), ordered(whole.vertices), rtol=0, atol=1e-12)


def test_a_part_knows_its_place():
    for part in extract_parts(Sphere(radius=0.5), resolution=64, cells=16, bounds=((-1, -1, -1), (1, 1, 1))):
        low = np.array(part.place) * 16 / 32 - 1
        assert (part.mesh.vertices >= low - 1e-9).all()
        assert (part.mesh.vertices <= low + 0.5 + 1e-9).all()


def test_wrong_arguments_and_no_surface():
    with pytest.raises(ValueError, match="power of two"):
        next(extract_parts(Sphere(), resolution=32, cells=12))
    with pytest.raises(NoSurfaceError):
        next(extract_parts(Sphere(radius=0.5), resolution=32, bounds=((0.9, 0.9, 0.9), (1, 1, 1))))


def test_an_interrupted_extraction_goes_on_from_the_parts_that_came():
    bumps = FunctionField(lambda x: x.norm(dim=-1) - 0.6 + 0.15 * (30 * x).sin().prod(dim=-1))
    settings = {"resolution": 48, "cells": 8, "lipschitz": 0.5}
    parts = list(extract_parts(bumps, **settings))
    whole = joined(parts)
    for came in (1, len(parts) // 2, len(parts) - 1):
        known = {part.place: part for part in parts[:came]}
        rest = list(extract_parts(bumps, **settings, known={place: part.border for place, part in known.items()}))
        assert len(known) + len(rest) <= len(parts)
        mesh = joined([*known.values(), *rest])
        assert_closed(mesh)
        assert np.array_equal(ordered(mesh.vertices), ordered(whole.vertices))
    assert not list(extract_parts(bumps, **settings, known={part.place: part.border for part in parts}))
