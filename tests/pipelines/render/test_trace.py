"""Images in strips: together they see what the whole camera sees."""

from collections.abc import Sequence

import torch
from mplicits.datasets import look_at
from mplicits.neural_fields import Sphere
from mplicits.pipelines.render.trace import Seen, fine_strips, strips, trace_view


def merge_strips(size: tuple[int, int], parts: Sequence[tuple[int, Seen]]) -> Seen:
    """What the whole image sees, from what its strips see and the row that each begins at."""
    colors = [part.color for _, part in parts if part.color is not None]
    return Seen(
        size=size,
        pixel=torch.cat([part.pixel + first * size[0] for first, part in parts]),
        depth=torch.cat([part.depth for _, part in parts]),
        position=torch.cat([part.position for _, part in parts]),
        normal=torch.cat([part.normal for _, part in parts]),
        direction=torch.cat([part.direction for _, part in parts]),
        color=torch.cat(colors) if len(colors) == len(parts) else None,
    )


def test_strips_see_together_what_the_camera_sees():
    field = Sphere(radius=0.5)
    camera = look_at((0.3, 0.4, 2.5), (0.0, 0.0, 0.0), fov=35.0, width=64, height=48)
    parts = list(strips(camera, lambda: 64 * 7))
    assert [first for first, _ in parts] == list(range(0, 48, 7))
    directions = torch.cat([strip.rays(dtype=torch.float64)[1] for _, strip in parts])
    torch.testing.assert_close(directions, camera.rays(dtype=torch.float64)[1], rtol=0, atol=1e-12)
    whole, merged = trace_view(field, camera), merge_strips((64, 48), [(y, trace_view(field, c)) for y, c in parts])
    assert merged.size == whole.size
    assert torch.equal(merged.pixel, whole.pixel)
    torch.testing.assert_close(merged.depth, whole.depth, rtol=0, atol=1e-4)
    torch.testing.assert_close(merged.part(slice(3, 9)).position, merged.position[3:9], rtol=0, atol=0)
    finer = fine_strips(camera, 2)
    assert [(strip.width, strip.height) for strip in finer] == [(128, 96)]
    expected = camera.resized(128, 96).intrinsics
    torch.testing.assert_close(finer[0].intrinsics, expected, rtol=0, atol=1e-12)
