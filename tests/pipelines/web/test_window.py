"""`show`: a page until it is closed, or in a notebook; `render`: the picture of a shape in memory."""

import sys
import types
import urllib.request
import webbrowser

import cv2
import numpy as np
import pytest
from mplicits.neural_fields import InputError, Similarity, Sphere, WorldField, save_field
from mplicits.pipelines.fit import Run
from mplicits.pipelines.render.draw import RenderOptions, render_run
from mplicits.pipelines.web import window
from mplicits.pipelines.web.window import in_notebook, until_closed

BALL = WorldField(Sphere(radius=0.5), Similarity((10.0, 0.0, 0.0), 4.0))


def test_a_shape_in_memory_is_drawn_as_its_file_is(tmp_path):
    save_field(tmp_path / "ball.safetensors", BALL.field, similarity=BALL.similarity)
    render_run(tmp_path / "ball.safetensors", tmp_path / "file.png", RenderOptions(size=(40, 30)))
    picture = BALL.render(tmp_path / "shape.png", size=(40, 30))
    assert (tmp_path / "file.png").read_bytes() == (tmp_path / "shape.png").read_bytes()
    assert np.array_equal(cv2.imread(str(tmp_path / "shape.png"))[..., ::-1], picture)
    plain = WorldField(lambda x: x.norm(dim=-1) - 0.5, BALL.similarity).render(size=(40, 30))
    assert abs(plain.astype(int) - picture).mean() < 1  # of 255: the same ball, its normals by autograd
    assert not np.array_equal(BALL.render(size=(40, 30), azimuth=200.0), picture)


def test_nothing_to_draw_is_said_in_one_line(tmp_path):
    with pytest.raises(InputError, match="no surface to render"):
        WorldField(lambda x: x.norm(dim=-1) + 1).render()
    with pytest.raises(InputError, match="xyz"):
        BALL.render(tmp_path / "ball.xyz")
    with pytest.raises(ValueError, match="levels 0 to 0"):
        BALL.render(level=1)


def test_a_script_waits_until_the_page_is_closed():
    visits = iter([0, 0, 1, 2, 1, 0, 1, 0, 0])
    until_closed(lambda: next(visits, 0), look=0.0, gone=0.0)
    assert list(visits) in ([1, 2, 1, 0, 1, 0, 0], [2, 1, 0, 1, 0, 0])  # someone has come; no patience was asked for

    def interrupted() -> int:
        raise KeyboardInterrupt

    until_closed(interrupted)  # no traceback


def test_the_page_of_a_script(monkeypatch, capsys):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    with BALL.show(block=False) as viewer:
        assert opened == [viewer.url]
        assert viewer.url in capsys.readouterr().out
        assert urllib.request.urlopen(viewer.url).status == 200
    monkeypatch.setattr(window, "until_closed", lambda clients: opened.append(str(clients())))
    assert Run(BALL.field, BALL.similarity, None, {}).show(browser=False) is None
    assert opened[1:] == ["0"]


def test_a_notebook_gets_a_page(monkeypatch):
    assert not in_notebook()
    notebook = types.ModuleType("IPython")
    notebook.get_ipython = lambda: types.SimpleNamespace(config={"IPKernelApp": {}})
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    cell = BALL.show()._repr_html_()
    assert cell.startswith('<iframe srcdoc="&lt;!doctype html&gt;')
    assert cell.count('"') == 4  # nothing of the page ends the attribute
