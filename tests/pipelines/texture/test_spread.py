"""Colours off a surface: those of its samples near it, averages further away, and no jumps in between."""

import math

import pytest
import torch
from mplicits.pipelines.texture.spread import CELL, SpreadColors


def test_one_colour_is_everywhere():
    points = torch.rand(500, 3) - 0.5
    spread = SpreadColors(points, torch.tensor([0.2, 0.5, 0.9]).expand(500, 3))
    found = spread(2 * torch.rand(300, 3) - 1, torch.rand(300))
    torch.testing.assert_close(found, torch.tensor([0.2, 0.5, 0.9]).expand(300, 3), atol=1e-5, rtol=0)


def test_near_samples_their_colours():
    """What is linear stays so between cells that all have samples in their middles."""
    middles = (torch.arange(round(2 / CELL)) + 0.5) * CELL - 1
    points = torch.cartesian_prod(middles, middles, middles)
    spread = SpreadColors(points, points)
    asked = 1.8 * torch.rand(200, 3) - 0.9
    torch.testing.assert_close(spread(asked, torch.zeros(200)), asked, atol=1e-5, rtol=0)


def test_no_jump_between_two_sides():
    """Half-way between a black and a white plane the nearest point jumps; r away, colours change by 3.5 / r at most."""
    sheet = torch.cartesian_prod(torch.linspace(-1, 1, 240), torch.linspace(-1, 1, 240))  # in every cell
    planes = [torch.cat((sheet, torch.full((len(sheet), 1), z)), dim=1) for z in (-0.4, 0.4)]
    white = torch.cat([torch.full((len(sheet), 1), float(side)) for side in (0, 1)])
    spread = SpreadColors(torch.cat(planes), white)
    across = torch.linspace(-0.38, 0.38, 4001)
    points = torch.stack((torch.full_like(across, 0.13), torch.full_like(across, -0.21), across), dim=1)
    reach = 0.4 - across.abs()
    found = spread(points, reach)[:, 0]
    # Between cells of width c ≥ r / 2 the slope is at most 1 / c; along log₂ r it is at most 1 / (r ln 2).
    assert (found.diff().abs() <= (2 + 1 / math.log(2)) / reach[1:].minimum(reach[:-1]) * across.diff() + 1e-5).all()
    torch.testing.assert_close(found + found.flip(0), torch.ones_like(found))  # the lattice is symmetric
    depth = (math.floor(0.4 / CELL) + 0.5) * CELL  # in cells with a plane in them
    middles = torch.tensor([[CELL / 2, CELL / 2, z] for z in (-depth, depth)])
    torch.testing.assert_close(spread(middles, torch.zeros(2))[:, 0], torch.tensor([0.0, 1.0]))


def test_without_samples():
    with pytest.raises(ValueError, match="points has no rows"):
        SpreadColors(torch.zeros(0, 3), torch.zeros(0, 3))
