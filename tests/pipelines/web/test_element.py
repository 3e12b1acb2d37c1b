"""The folder that `mplicits web` writes, in another's page with a strict policy, served from this machine."""

import functools
import http.server
import json
import re
import struct
import zlib
from pathlib import Path

import pytest
import torch
from browser import served
from mplicits.neural_fields import Similarity, save_field
from mplicits.pipelines.cli import main
from mplicits.pipelines.web.export import BITS
from mplicits.pipelines.web.payload import rounded_field
from pages import bumpy, until

POLICY = "default-src 'none'; script-src 'self'; connect-src 'self'; style-src 'none'"
HOST = """<!doctype html><html><head><title>host</title>
<script type="module" src="mplicits-field.js"></script></head><body>
<h1 id="title">Mine</h1><mplicits-field src="{src}" camera="90,0" level="1"></mplicits-field></body></html>"""
SOURCES = Path(__file__).parents[3] / "pipelines" / "web" / "page"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("site")
    save_field(place / "ball.safetensors", bumpy(), similarity=Similarity((5.0, 6.0, 7.0), 100.0))
    assert main(["web", str(place / "ball.safetensors"), "-o", str(place / "ball")]) == 0
    return place / "ball"


@pytest.fixture
def site(folder):
    """The folder on a port of this machine, and pages that hold an element."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            found = re.fullmatch(r"/host-(.+)\.html", self.path)
            if not found:
                super().do_GET()
                return
            body = HOST.format(src=found[1]).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Security-Policy", POLICY)
            self.end_headers()
            self.wfile.write(body)

    with served(functools.partial(Handler, directory=str(folder))) as address:
        yield address


def test_what_is_in_the_folder(folder):
    names = ["README.md", "field.bin", "index.html", "mplicits-field.d.ts", "mplicits-field.js"]
    assert sorted(path.name for path in folder.iterdir()) == names
    data = (folder / "field.bin").read_bytes()
    assert data.startswith(b"mplicits-field\n")
    (length,) = struct.unpack_from("<I", data, 15)
    header = json.loads(data[19 : 19 + length])
    assert header["title"] == "ball"
    assert len(zlib.decompress(data[19 + length :], -zlib.MAX_WBITS)) == header["bytes"]
    assert (folder / "README.md").read_text().startswith("# ball\n")
    # What the types promise is there.
    promised = re.findall(r"^  (?:readonly )?(\w+)[(:]", _class(SOURCES / "mplicits-field.d.ts"), re.M)
    there = re.findall(r"^  (?:get |async )?(\w+)\(", _class(SOURCES / "element.js"), re.M)
    assert {"render", "header"} < set(promised) <= set(there)


def _class(file):
    return re.search(r"class MplicitsField.*?^}", file.read_text(), re.M | re.S)[0]


def test_a_field_in_another_page(browser, site):
    browser.get(f"{site}/host-field.bin.html")
    find = "return document.querySelector('mplicits-field')"
    until(lambda: browser.execute_script(f"{find}.dataset.drawn"))
    assert browser.title == "host"  # nothing of the other page is touched
    assert browser.find_element("id", "title").text == "Mine"
    assert browser.execute_script(f"{find}.page.level") == 1
    assert browser.execute_script(f"{find}.page.orbit.azimuth") == 90
    point = [0.3, 0.2, -0.4]
    script = f"{find}.renderer.values(Float32Array.from(arguments[0]), 0).then((f) => Array.from(f))"
    expected = rounded_field(bumpy(), BITS).value(torch.tensor([point]), level=0).item()
    assert browser.execute_script(script, point) == pytest.approx([expected], abs=1e-4)
    panel = "document.querySelector('mplicits-field').shadowRoot.getElementById('panel')"
    style = browser.execute_script(f"return getComputedStyle({panel}).position")
    assert style == "absolute"  # its styles are there in spite of the policy
    refused = [entry["message"] for entry in browser.get_log("browser") if "Content Security" in entry["message"]]
    assert not refused
    # Taken out and put back, it begins anew.
    browser.execute_script("window.kept = document.querySelector('mplicits-field'); window.kept.remove()")
    assert browser.execute_script("return window.kept.page === null && window.kept.dataset.drawn === undefined")
    browser.execute_script("document.body.append(window.kept)")
    until(lambda: browser.execute_script(f"{find}.dataset.drawn"))


@pytest.mark.parametrize(
    ("src", "expected"),
    [("none.bin", "404"), ("README.md", "no field of mplicits"), ("cut.bin", "cut off"), ("", "names one")],
)
def test_what_is_wrong_is_told_in_the_element(browser, site, folder, src, expected):
    if src == "cut.bin":
        (folder / src).write_bytes((folder / "field.bin").read_bytes()[:-100])
    browser.get(f"{site}/host-{src or ' '}.html")
    if not src:
        browser.execute_script("document.querySelector('mplicits-field').removeAttribute('src')")
        browser.execute_script("document.querySelector('mplicits-field').load()")
    said = "return document.querySelector('mplicits-field')?.shadowRoot?.getElementById('reason')?.textContent"
    assert expected in until(lambda: expected in (found := browser.execute_script(said) or "") and found)


def test_folders_of_others_are_left_alone(folder, tmp_path, capsys):
    run = str(folder.parent / "ball.safetensors")
    assert main(["web", run, "-o", str(folder)]) == 0  # its own is written anew
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["web", run, "-o", str(tmp_path)]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert main(["web", run, "-o", str(tmp_path / "notes")]) == 0
    (tmp_path / "plain").write_text("mine")
    assert main(["web", run, "-o", str(tmp_path / "plain")]) == 2
    assert "is a file" in capsys.readouterr().err
