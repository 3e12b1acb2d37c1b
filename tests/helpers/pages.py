"""What tests of pages share: a small field with colours, pictures that a page traces, what they are held against."""

import base64
import json
import re
import time
from typing import NamedTuple

import numpy as np
import torch
from fields import solve_sphere
from mplicits.neural_fields import MultiscaleSDF, Siren, TextureField, sphere_trace
from mplicits.neural_fields.networks.colors import ColorSiren

PATIENCE = 60.0
TITLE = "<img src=x onerror=alert(1)> & ball"


def bumpy(*, gain=0.5):
    """A sphere of level 0 and bumps of two levels in its bands: no bump is larger than its band, unless ``gain`` is."""
    torch.manual_seed(3)
    base = Siren(32, 2, omega=6.0)
    solve_sphere(base, 0.6)
    residuals = [Siren(18, 2, omega=8.0, output_gain=gain), Siren(16, 3, omega=16.0, output_gain=0.1)]
    return MultiscaleSDF(base, residuals, [0.12, 0.05], taper=0.3).requires_grad_(False)


def painted():
    """Colours in a band that holds most of the coarsest level's surface, but not all."""
    torch.manual_seed(4)
    color = ColorSiren(16, 2, omega=8.0)
    return TextureField(bumpy(), color, delta=0.02, outside=(1.0, 0.0, 0.0)).requires_grad_(False)


def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)
    return found


RENDER = """
return window.mplicits.render(arguments[0]).then((made) => {
const bytes = new Uint8Array(made.seen.buffer);
let text = '';
for (let i = 0; i < bytes.length; i += 4096) text += String.fromCharCode(...bytes.subarray(i, i + 4096));
return {seen: btoa(text), color: Array.from(made.color), counts: made.counts};
});
"""


def rendered(browser, camera, **wanted):
    """Normals and depths ``(H, W, 4)`` that the page traces, what they have cost, and among that the colours."""
    fx, fy, cx, cy = camera.fx_fy_cx_cy
    view = {name: getattr(camera, name).tolist() for name in ("eye", "right", "down", "forward")}
    view |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": camera.width, "height": camera.height}
    made = browser.execute_script(RENDER, {"camera": view, **wanted})
    seen = np.frombuffer(base64.b64decode(made["seen"]), np.float32)
    counts = made["counts"] | {"color": np.array(made["color"], np.float32).reshape(-1, 4)}
    return seen.reshape(camera.height, camera.width, 4), counts


class Differences(NamedTuple):
    """Of a picture of a page from what the tracer of this package finds."""

    hits: int  # rays that meet the surface, by the tracer
    mask: float  # share of the pixels that meet it in one alone
    depth: np.ndarray  # (N,) where both meet it, in units of the field
    angle: np.ndarray  # (N,) between normals, in degrees


def differences(found, field, camera, level, *, tolerance, resolution) -> Differences:
    eye, directions = camera.rays()
    hits = sphere_trace(field, eye, directions, level=level, tolerance=tolerance, resolution=resolution)
    mask = hits.mask.numpy()
    both = (found[..., 3] > 0) & mask
    slopes = field.jet(hits.position[torch.from_numpy(both)], level=level).gradient
    normals = torch.nn.functional.normalize(slopes, dim=-1)
    chord = np.linalg.norm(normals.numpy() - found[both][:, :3], axis=-1)
    return Differences(
        int(mask.sum()),
        float(((found[..., 3] > 0) != mask).mean()),
        np.abs(found[..., 3] - hits.depth.numpy())[both],
        np.degrees(2 * np.arcsin(chord.clip(0, 2) / 2)),
    )


def open_page(browser, address, flags="", *, kind="WebGL 2"):
    """Open a page with rays of 16 pixels at rest, as software is slow; `kind` is what it must trace with."""
    parameters = "&".join(["pixel=16", *([flags] if flags else []), *(["webgl"] if kind == "WebGL 2" else [])])
    browser.get_log("browser")  # messages of pages before this one
    browser.get(f"{address}{'&' if '?' in address else '?'}{parameters}")
    until(lambda: browser.execute_script("return window.mplicits?.renderer?.kind"))
    assert browser.execute_script("return window.mplicits.renderer.kind") == kind


def written_header(page):
    """What a page holds about its field or shapes."""
    return json.loads(re.search(r'id="header">(.*?)</script>', page.read_text(encoding="utf-8"))[1])


def round_field(radius, *, levels=1):
    """A SIREN that is nearly a ball, and residuals in a wide band, which cannot be trained."""
    torch.manual_seed(0)
    base = Siren(16, 1, omega=4.0)
    solve_sphere(base, radius)
    residuals = [Siren(8, 1, omega=5.0, output_gain=0.05) for _ in range(levels - 1)]
    return MultiscaleSDF(base, residuals, [0.2] * (levels - 1)).requires_grad_(False)
