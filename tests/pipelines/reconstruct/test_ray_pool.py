"""Rays drawn from pictures: each one is the ray of its camera, with the colour and the mask of its pixel."""

import numpy as np
import pytest
import torch
from mplicits.datasets import look_at
from mplicits.datasets.views.images import PosedImage
from mplicits.neural_fields import InputError, Similarity
from mplicits.neural_fields.volume.weights import sphere_span
from mplicits.pipelines.reconstruct.model.model import RayPool, camera_rays

WORLD = Similarity(center=(50.0, -20.0, 7.0), scale=4.0)
CPU = torch.device("cpu")


def view(number: int, width: int, height: int, *, masked: bool, back: bool = False, fov: float = 40.0) -> PosedImage:
    """A picture of the unit sphere, in world coordinates, whose colours spell (view, y, x) of each pixel."""
    eye = WORLD.to_input(3.0 * np.array([[1.0, 0.2, 0.1], [0.1, 0.3, -1.0], [-0.5, -1.0, 0.4]])[number])
    target = 2 * eye - np.array(WORLD.center) if back else np.array(WORLD.center)
    camera = look_at(eye.tolist(), target.tolist(), fov=fov, width=width, height=height)
    y, x = np.mgrid[:height, :width]
    color = np.stack((np.full_like(x, number), y, x), axis=-1).astype(np.float32) / 255
    mask = ((11 * x + 7 * y + number) % 256).astype(np.float32) / 255 if masked else None
    return PosedImage(f"{number}.png", camera, color, mask)


def views(*, masked: bool = True) -> list[PosedImage]:
    return [view(0, 14, 9, masked=masked), view(1, 8, 12, masked=masked), view(2, 10, 10, masked=masked, fov=60)]


def places(pool: RayPool, count: int = 20_000) -> tuple[list[tuple[int, int, int]], torch.Tensor, torch.Tensor]:
    """(view, y, x) of drawn rays, their origins and their directions."""
    rays = pool.draw(count, torch.Generator().manual_seed(1))
    where = (rays.color * 255).round().long().tolist()
    return [(number, y, x) for number, y, x in where], rays.origins, rays.directions


def test_a_drawn_ray_is_that_of_its_pixel_with_its_colour_and_mask() -> None:
    pictures = views()
    pool = RayPool(pictures, WORLD, CPU)
    rays = pool.draw(500, torch.Generator().manual_seed(0))
    assert rays.origins.dtype == rays.directions.dtype == rays.color.dtype == rays.mask.dtype == torch.float32
    number, y, x = (rays.color * 255).round().long().unbind(dim=1)
    assert set(number.tolist()) == {0, 1, 2}
    for index, picture in enumerate(pictures):
        rows = number == index
        eye, directions = picture.camera.moved(WORLD).rays()
        torch.testing.assert_close(rays.origins[rows], eye.expand(int(rows.sum()), 3), atol=1e-6, rtol=0)
        torch.testing.assert_close(rays.directions[rows], directions[y[rows], x[rows]], atol=1e-6, rtol=0)
        assert picture.mask is not None
        mask = torch.from_numpy(picture.mask)[y[rows], x[rows]]
        torch.testing.assert_close(rays.mask[rows], mask, atol=1e-7, rtol=0)


def test_rays_in_the_unit_sphere_pass_through_the_world_points_of_the_camera() -> None:
    picture = view(0, 14, 9, masked=False)
    origins, directions = camera_rays(picture.camera.moved(WORLD))
    assert origins.shape == directions.shape == (14 * 9, 3)
    there = WORLD.to_input((origins + 2.5 * directions).double().numpy())
    pixels, depth = picture.camera.project(torch.from_numpy(there))
    y, x = np.mgrid[:9, :14]
    assert np.allclose(pixels.numpy(), np.stack((x.ravel(), y.ravel()), axis=1), atol=1e-4)
    assert bool((depth > 0).all())


def test_pixels_that_miss_the_sphere_are_never_drawn_and_all_others_are() -> None:
    pictures = views()
    pool = RayPool(pictures, WORLD, CPU)
    expected = set()
    for index, picture in enumerate(pictures):
        near, far = sphere_span(*camera_rays(picture.camera.moved(WORLD)))
        meets = (far > near).reshape(picture.color.shape[:2])
        expected |= {(index, y, x) for y, x in meets.nonzero().tolist()}
    everything = sum(picture.color.shape[0] * picture.color.shape[1] for picture in pictures)
    assert 0.3 * everything < len(expected) < 0.95 * everything  # a test of both kinds of pixels
    assert len(pool) == len(expected)
    assert set(places(pool)[0]) == expected


@pytest.mark.parametrize("whole", [False, True])
def test_pixels_that_are_left_out_are_never_drawn(whole: bool) -> None:
    pictures = views()
    hole = np.zeros(pictures[1].color.shape[:2], dtype=bool)
    hole[3:9, 2:6] = True
    everything, rest = (places(RayPool(pictures, WORLD, CPU, whole=whole, left_out=out))[0] for out in ({}, {1: hole}))
    assert set(rest) == {(number, y, x) for number, y, x in everything if number != 1 or not hole[y, x]}
    assert len(set(rest)) < len(set(everything))


def test_all_pixels_are_drawn_where_the_outside_is_learnt() -> None:
    pictures = views()
    pool = RayPool(pictures, WORLD, CPU, whole=True)
    every = {(index, y, x) for index, picture in enumerate(pictures) for y, x in np.ndindex(*picture.color.shape[:2])}
    assert len(pool) == len(every)
    assert set(places(pool)[0]) == every


def test_all_pixels_are_equally_likely() -> None:
    pool = RayPool(views(), WORLD, CPU)
    where, _, _ = places(pool, 100 * len(pool))
    _, counts = np.unique(np.array(where), axis=0, return_counts=True)
    # χ² with n − 1 degrees of freedom is within five standard deviations of its mean.
    excess = ((counts - 100.0) ** 2 / 100).sum() - (len(pool) - 1)
    assert abs(excess) < 5 * (2 * len(pool)) ** 0.5


def test_drawing_repeats_with_the_same_generator_only() -> None:
    pool = RayPool(views(), WORLD, CPU)
    first, again, other = (pool.draw(50, torch.Generator().manual_seed(seed)) for seed in (3, 3, 4))
    assert torch.equal(first.color, again.color)
    assert not torch.equal(first.color, other.color)


def test_without_masks_everything_counts_as_object() -> None:
    pool = RayPool(views(masked=False), WORLD, CPU)
    assert not pool.has_masks
    assert pool.draw(30, torch.Generator()).mask.tolist() == [1.0] * 30
    # One view without a mask: nobody knows what is object there.
    assert not RayPool([*views(), view(0, 14, 9, masked=False)], WORLD, CPU).has_masks


def test_a_pixel_costs_ten_bytes_with_its_mask() -> None:
    pool = RayPool(views(), WORLD, CPU)
    assert pool.masks is not None
    tensors = (pool.colors, pool.masks, pool.pixels, pool.owners)
    assert pool.colors.dtype == pool.masks.dtype == torch.uint8
    assert sum(tensor.nbytes for tensor in tensors) == 10 * len(pool)  # 3 colour, 1 mask, 4 pixel, 2 view


def test_cameras_that_all_look_away_are_refused() -> None:
    away = [view(number, 8, 8, masked=True, back=True) for number in range(3)]
    with pytest.raises(InputError, match="sees the region of interest; see `mplicits check-cameras`"):
        RayPool(away, WORLD, CPU)
    with pytest.raises(InputError, match="sees the region of interest"):
        RayPool(away, WORLD, CPU, whole=True)
    mixed = RayPool([away[0], *views()[1:]], WORLD, CPU)
    assert {number for number, _, _ in places(mixed)[0]} == {1, 2}
