"""Images in strips: together they see what the whole camera sees."""

import torch
from mplicits.datasets import look_at
from mplicits.neural_fields import Sphere
from mplicits.pipelines.render.trace import fine_strips, trace_view


def test_strips_see_together_what_the_camera_sees():
    field = Sphere(radius=0.5)
    camera = look_at((0.3, 0.4, 2.5), (0.0, 0.0, 0.0), fov=35.0, width=64, height=48)
    parts = fine_strips(camera, 1, pixels=64 * 7)
    assert [strip.height for strip in parts] == [7] * 6 + [6]
    directions = torch.cat([strip.rays(dtype=torch.float64)[1] for strip in parts])
    torch.testing.assert_close(directions, camera.rays(dtype=torch.float64)[1], rtol=0, atol=1e-12)
    whole = trace_view(field, camera)
    seen = [trace_view(field, strip) for strip in parts]
    pixel = torch.cat([part.pixel + 64 * 7 * index for index, part in enumerate(seen)])
    assert torch.equal(pixel, whole.pixel)
    torch.testing.assert_close(torch.cat([part.depth for part in seen]), whole.depth, rtol=0, atol=1e-4)
    finer = fine_strips(camera, 2)
    assert [(strip.width, strip.height) for strip in finer] == [(128, 96)]
    expected = camera.resized(128, 96).intrinsics
    torch.testing.assert_close(finer[0].intrinsics, expected, rtol=0, atol=1e-12)
