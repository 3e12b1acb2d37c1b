"""The page as a file: its policy, what of the run is in it, and one line for each mistake."""

import base64
import hashlib
import re
import zlib

import numpy as np
import pytest
from evolutions import fails
from mplicits.neural_fields import Similarity, save_field
from mplicits.neural_fields.spacetime.field import SpaceTimeSDF
from mplicits.pipelines.cli import main
from mplicits.pipelines.web.export import BITS
from mplicits.pipelines.web.payload import text_of
from pages import bumpy, written_header

NASTY = '</script><img src=x onerror="document.title=1">@DATA@'


BALL = bumpy()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    file = tmp_path_factory.mktemp("run") / "ball.safetensors"
    save_field(file, BALL, similarity=Similarity((1e6, 2.0, 3.0), 40.0), metadata={"secret": "a name of the user"})
    return file


def web(*words):
    return main(["web", *(str(word) for word in words)])


def bytes_of(text):
    """What `text_of` has written, by whole numbers of any length."""
    letters = [chr(code) for code in range(33, 127) if chr(code) not in '"&<']
    pairs, odd = divmod(len(text), 2)
    groups = [letters.index(text[2 * k]) + 91 * letters.index(text[2 * k + 1]) for k in range(pairs)]
    groups += [letters.index(letter) for letter in text[2 * pairs :]]
    whole = sum(group << (13 * k) for k, group in enumerate(groups))
    size = (13 * pairs + 6 * odd) // 8
    assert whole >> (8 * size) == 0
    return whole.to_bytes(size, "little")


def test_bytes_come_back_from_letters():
    rng = np.random.default_rng(0)
    for size in range(60):
        data = rng.bytes(size)
        text = text_of(data)
        assert bytes_of(text) == data
        assert len(text) == -(-8 * size // 13) * 2 - (0 < 8 * size % 13 <= 6)
        assert not set(text) & set('"&< \n')
    assert bytes_of(text_of(b"\xff" * 100)) == b"\xff" * 100


def test_a_page_is_whole_and_lets_nothing_else_in(run, tmp_path, capsys):
    out = tmp_path / "page.html"
    assert web(run, "-o", out) == 0
    assert f"weights of {BITS} bits: distances change by at most" in capsys.readouterr().out
    text, header = out.read_text(encoding="utf-8"), written_header(out)
    data = zlib.decompress(bytes_of(re.search(r'id="data">(.*?)</script>', text)[1]), -zlib.MAX_WBITS)
    assert header["bytes"] == len(data)
    assert header["crc32"] == zlib.crc32(data)
    assert [part["width"] for part in header["levels"]] == [32, 18, 16]
    assert header["title"] == "ball"
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert policy.startswith("default-src 'none'; ")
    (boot,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    (style,) = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    packed = bytes_of(re.search(r'id="code">(.*?)</script>', text)[1])
    script = zlib.decompress(packed, -zlib.MAX_WBITS).decode().split("\0")[1]
    digests = [base64.b64encode(hashlib.sha256(part.encode()).digest()).decode() for part in (boot, script, style)]
    assert "script-src 'sha256-{}' 'sha256-{}'; style-src 'sha256-{}';".format(*digests) in policy
    assert "unsafe" not in policy
    assert "innerHTML" not in text + script
    assert not re.search(r"https?://", text + script)  # not even the name of a namespace
    assert "a name of the user" not in text


def test_the_title_is_text_whatever_it_is(run, tmp_path):
    out = tmp_path / "page.html"
    assert web(run, "-o", out, "--title", NASTY) == 0
    assert written_header(out)["title"] == NASTY
    assert "<img" not in out.read_text(encoding="utf-8")


def test_exact_weights_and_fewer_levels(run, tmp_path, capsys):
    sizes = {}
    for name, flags in {"all": [], "one": ["--levels", "1"], "exact": ["--float32"]}.items():
        out = tmp_path / f"{name}.html"
        assert web(run, "-o", out, *flags) == 0
        sizes[name], header = out.stat().st_size, written_header(out)
        assert len(header["levels"]) == (1 if name == "one" else 3)
        assert header["bits"] == (None if name == "exact" else BITS)
    assert sizes["one"] < sizes["all"] < sizes["exact"]
    assert "weights of" not in capsys.readouterr().out.splitlines()[-1]


def test_a_moment_of_a_field_that_moves(tmp_path):
    file, page = tmp_path / "moving.safetensors", tmp_path / "page.html"
    save_field(file, SpaceTimeSDF.from_static(BALL))
    assert web(file, "-o", page, "--time", 0.5) == 0
    assert [part["width"] for part in written_header(page)["levels"]] == [32, 18, 16]


def test_mistakes_are_one_line(run, tmp_path, capsys):
    foreign = tmp_path / "letter.html"
    foreign.write_text("<p>mine")
    moving = tmp_path / "moving.safetensors"
    save_field(moving, SpaceTimeSDF.from_static(BALL))
    out = tmp_path / "page.html"
    for words, expected in (
        (f"{run} -o {tmp_path}/page.png", "unknown extension"),
        (f"{run} -o {foreign}", "no page of this command"),
        (f"{tmp_path}/none -o {out}", "no such file"),
        (f"{moving} -o {out} --cloud {foreign}", "--cloud"),
        (f"{run} -o {out} --levels 4", "has levels 0 to 2"),
        (f"{run} -o {out} --time 0.5", "does not move"),
    ):
        assert expected in fails(capsys, f"web {words}")
    assert not out.exists()
    assert foreign.read_text() == "<p>mine"
    assert web(run, "-o", foreign, "--force") == 0
    assert web(run, "-o", foreign) == 0  # a page of this command may be written again
