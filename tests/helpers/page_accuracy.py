"""What a page draws against the tracer of this package: ``python tests/helpers/page_accuracy.py RUN [RUN …]``.

Each run is drawn by a headless Chromium and traced with the same rounded weights; then follow the costs of each level.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from browser import start_browser
from mplicits.datasets.cameras import turntable
from mplicits.neural_fields import extract_mesh
from mplicits.pipelines.training.folder import load_still
from mplicits.pipelines.web.export import BITS, WebOptions, web_run
from mplicits.pipelines.web.payload import rounded_field
from pages import differences, rendered, until

TOLERANCE, RESOLUTION = 2e-5, 1e-4
TURNS = (30.0, 150.0, 270.0)


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


def described(name, told):
    each = " + ".join(f"{asked:.2f}" for asked in told["evaluations"])
    return f"| {name} | {each} | {told['operations'] / 1e9:.2f} | {told['passes']:.0f} | {told['milliseconds']:.0f} |"


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
                told = costs(browser, arguments.size[0], range(field.num_levels))
                for level, costs_of_level in enumerate(told):
                    print(described(f"level {level}", costs_of_level))
        finally:
            browser.quit()


if __name__ == "__main__":
    main()
