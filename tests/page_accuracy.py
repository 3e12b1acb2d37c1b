"""What a page draws against the tracer of this package: ``python tests/page_accuracy.py RUN [RUN …]``.

Each run is written as a page, drawn by a headless Chromium in software at the page's own precision, and traced with the
same rounded weights to 2·10⁻⁵. With ``--siren`` also what a single SIREN of 400 × 4 costs in the same shaders, which is
first taught the run's finest level; with ``--half`` how far values would be off in float16.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from browser import start_browser
from mplicits.datasets.cameras import turntable
from mplicits.neural_fields import Siren, extract_mesh, save_field
from mplicits.neural_fields.networks.multiscale import levels_of
from mplicits.pipelines.training.folder import load_still
from mplicits.pipelines.web.export import BITS, WebOptions, web_run
from mplicits.pipelines.web.networks import network_layers, rounded_field
from pages import differences, rendered, until

TOLERANCE, RESOLUTION = 2e-5, 1e-4
TURNS = (30.0, 150.0, 270.0)
LESSONS, POINTS, RATE = 400, 4096, 3e-4  # of the single SIREN
OMEGA = 30.0


def accuracy(browser, field, up, size):
    """A row of the table for each level, of pictures from around."""
    outline = extract_mesh(field, resolution=96, normals=False).vertices
    width, height = size
    for level in range(field.num_levels):
        rows = []
        for turn in TURNS:
            camera = turntable(outline, 1, azimuth=turn, up=up, width=width, height=height)[0]
            found, _ = rendered(browser, camera, level=level)
            rows.append(differences(found, field, camera, level, tolerance=TOLERANCE, resolution=RESOLUTION))
        depth, angle = (np.concatenate([getattr(row, name) for row in rows]) for name in ("depth", "angle"))
        wrong = 100 * np.mean([row.mask for row in rows])
        over = [100 * (depth > 1e-3).mean(), 100 * (angle > 2).mean()]
        print(f"| level {level} | {wrong:.3f} % | {over[0]:.2f} % | {over[1]:.2f} % |")


def taught(field, outline):
    """A SIREN of 400 × 4 near to the finest level: about its surface most, and everywhere in the sphere."""
    torch.manual_seed(0)
    siren = Siren(400, 4, omega=OMEGA)
    learn = torch.optim.Adam(siren.parameters(), lr=RATE)
    places = torch.from_numpy(np.asarray(outline, np.float32))
    for lesson in range(LESSONS):
        for group in learn.param_groups:
            group["lr"] = RATE * (1 - lesson / LESSONS)
        near = places[torch.randint(len(places), (POINTS // 2,))] + 0.03 * torch.randn(POINTS // 2, 3)
        x = torch.cat((near, 2 * torch.rand(POINTS // 2, 3) - 1))
        with torch.no_grad():
            wanted = field.value(x)
        loss = (siren.value(x) - wanted).square().mean()
        learn.zero_grad()
        loss.backward()
        learn.step()
    return siren.requires_grad_(False)


def described(name, told):
    each = " + ".join(f"{asked:.2f}" for asked in told["evaluations"])
    return (
        f"| {name} | {each} | {told['operations'] / 1e9:.2f} | {told['passes']:.0f} | {told['milliseconds']:.0f} | "
        f"{told['model']:.0f} |"
    )


def half(weight, hidden):
    """A product of float16 numbers, added up in float16."""
    total = np.zeros((len(hidden), len(weight)), np.float16)
    for column in range(weight.shape[1]):
        total += hidden[:, column : column + 1] * weight[:, column]
    return total


def half_errors(network, points):
    """How far values at points are off if weights and activations between sine layers are float16.

    Returns:
        The most where products are added up in float32, and in float16.
    """
    layers, found = network_layers(network, None), []
    for wide in (True, False):
        hidden = points
        for index, layer in enumerate(layers[:-1]):
            if index == 0:
                turns = hidden @ layer.weight.T + layer.bias
            else:
                weight = layer.weight.astype(np.float16)
                product = hidden.astype(np.float32) @ weight.astype(np.float32).T if wide else half(weight, hidden)
                turns = product.astype(np.float32) + layer.bias
            hidden = np.sin(2 * np.pi * (turns - np.round(turns))).astype(np.float16)
        value = (hidden.astype(np.float32) @ layers[-1].weight.T + layers[-1].bias)[:, 0]
        found.append(float(np.abs(value - network.value(torch.from_numpy(points)).numpy()).max()))
    return found


def costs(browser, size, levels):
    """What the page's own bench says of each level."""
    begin = "window.told = null; window.mplicits.bench(arguments[0]).then((found) => { window.told = found; })"
    found = []
    for level in levels:
        browser.execute_script(f"{{ {begin} }}", {"size": size, "frames": 3, "level": level})
        while (told := browser.execute_script("return window.told")) is None:  # minutes, where others hold the cores
            time.sleep(0.2)
        found.append(told)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--up", default="y", choices=["y", "z"])
    parser.add_argument("--size", type=int, nargs=2, default=[96, 72], metavar=("W", "H"))
    parser.add_argument("--webgl", action="store_true")
    parser.add_argument("--siren", action="store_true")
    parser.add_argument("--half", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        browser = start_browser(Path(folder) / "profile")
        if browser is None:
            parser.exit(2, "no chromium and chromedriver on this machine\n")

        def opened(page):
            browser.get(f"{page.as_uri()}?pixel=16{'&webgl' if arguments.webgl else ''}")
            until(lambda: browser.execute_script("return window.mplicits?.renderer?.kind"))

        try:
            for run in arguments.runs:
                field, page = load_still(run).field, Path(folder) / "page.html"
                web_run(run, page, WebOptions(up=arguments.up, colors=False))
                opened(page)
                print(f"{run}, {browser.execute_script('return window.mplicits.renderer.kind')}")
                accuracy(browser, rounded_field(field, BITS), arguments.up, arguments.size)
                if arguments.half:
                    outline = extract_mesh(field, resolution=64, normals=False).vertices
                    points = np.asarray(outline, np.float32)[:: max(1, len(outline) // POINTS)]
                    for level, network in enumerate(levels_of(field)):
                        wide, narrow = half_errors(network, points)
                        print(f"| level {level} | {wide:.1e} | {narrow:.1e} |")
                told = costs(browser, arguments.size[0], range(field.num_levels))
                names = [f"level {level}" for level in range(field.num_levels)]
                if arguments.siren:
                    siren = taught(field, extract_mesh(field, resolution=96, normals=False).vertices)
                    save_field(Path(folder) / "siren.safetensors", siren)
                    web_run(Path(folder) / "siren.safetensors", page, WebOptions(up=arguments.up))
                    opened(page)
                    told += costs(browser, arguments.size[0], [0])
                    names.append("SIREN 400 × 4")
                for row in zip(names, told, strict=True):
                    print(described(*row))
        finally:
            browser.quit()


if __name__ == "__main__":
    main()
