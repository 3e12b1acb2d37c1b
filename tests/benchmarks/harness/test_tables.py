import csv
import io
import json
from xml.etree import ElementTree

import pytest

from benchmarks.harness import report
from benchmarks.harness.plots import Plot, Series, to_svg
from benchmarks.harness.tables import Column, Row, Table
from benchmarks.paper.comparison import banf_tables, comparison_tables, noise_plots, noise_tables, poisson_tables
from benchmarks.paper.published import BANF, COMPARISON, NOISE


def record(shape, method, chamfers, *, iou=0.9, deltas=(), **job):
    """One whose outputs are named after their Chamfer distances' keys."""
    fields = {"noise": 0.0, "outliers": 0.0, "flipped": 0.0, "overrides": {}, "preset": "smoke", "seed": 0} | job
    found = {"chamfer_floor": 1e-6, "iou": iou, "shell_iou": iou / 2, "components": 3, "rays_per_second": 4 * 512**2}
    outputs = []
    for name, value in chamfers.items():
        output = {"name": name, "chamfer": value, "train_seconds": 30.0, "mesh_seconds": 2.0, "parameters": 10}
        outputs.append(output | ({} if value is None else found))
    return {
        "cell": {"shape": shape, "method": method, **fields},
        "method": {"source": f"by {method}", "differs": f"not {method}"},
        "outputs": outputs,
        "deltas": list(deltas),
    }


def rows_of(table):
    return {row.name: dict(zip((c.name for c in table.columns), row.values, strict=True)) for row in table.rows}


def test_comparison() -> None:
    records = [
        record("a", "ours", {"Ours coarse": 4e-5, "Ours fine": 1e-5}, iou=0.8),
        record("b", "ours", {"Ours coarse": 6e-5, "Ours fine": 2e-5}, iou=0.9),
        record("c", "ours", {"Ours coarse": 8e-5, "Ours fine": 6e-5}, iou=1.0),
        record("a", "idf", {"IDF": 1e-4}),
        record("b", "idf", {"IDF": None}),
        record("c", "poisson", {"Screened Poisson": 9e-5}),
    ]
    table, chamfer, _, parts = comparison_tables(records)
    rows = rows_of(table)
    expected = {"mean CD": 3e-5, "median CD": 2e-5, "mean IoU": 0.9, "mean shell IoU": 0.45, "training (min)": 0.5}
    expected |= {"FPS at 512²": 4, "parameters": 10, "meshing (s)": 2.0}
    assert {name: rows["Ours fine"][name] for name in expected} == pytest.approx(expected)
    assert (rows["Ours fine"]["found"], rows["IDF"]["found"], rows["IDF"]["mean CD"]) == ("3/3", "1/2", 1e-4)
    assert rows["(sampling floor)"]["mean CD"] == pytest.approx(1e-6)
    assert "3.00 times lower" in table.notes[0]
    by_name = {row.name: row for row in table.rows}
    assert by_name["IDF"].published[:4] == COMPARISON["IDF"][:4]
    assert by_name["Screened Poisson"].published is None
    assert (by_name["IDF"].source, by_name["IDF"].differs) == ("by idf", "not idf")
    assert rows_of(chamfer)["IDF"] == {"a": 1e-4, "b": None, "c": None}
    assert rows_of(parts)["Ours fine"] == {"a": 3, "b": 3, "c": 3}


def test_noise_is_told_from_the_clean_cells_of_its_curves() -> None:
    records = [
        record("a", "ours", {"Ours fine": 1e-5}),
        record("a", "ours", {"Ours fine": 2e-5}, noise=0.01),
        record("a", "ours", {"Ours fine": 3e-5}, noise=0.02),
        record("a", "poisson", {"Screened Poisson": 8e-5}, noise=0.01),
        record("a", "idf", {"IDF": 5e-5}, noise=0.01),
    ]
    table, *_ = noise_tables(records)
    assert rows_of(table)["Ours fine"]["mean CD"] == 2e-5
    assert table.rows[0].published == (*NOISE["Ours fine"], None, None, None)
    assert "2.50 times lower" in table.notes[0]
    assert "4.00 times below that of screened Poisson" in table.notes[0]
    curves, everything, levels, *pairs = noise_plots(records)
    assert curves.places == ("0 %", "1 %", "2 %")
    assert curves.series == (Series("Ours fine", (1e-5, 2e-5, 3e-5)),)
    assert [series.name for series in everything.series] == ["Ours fine", "Screened Poisson", "IDF"]
    assert everything.series[0].values == (2e-5,)
    assert [series.name for series in levels.series] == ["Ours fine"]
    assert len(pairs) == 2


def test_poisson() -> None:
    records = [
        record("a", "ours", {"Ours coarse": 9e-5, "Ours fine": 1e-5}),
        record("a", "ours", {"Ours coarse": 9e-5, "Ours fine": 2e-5}, noise=0.01),
        record("a", "poisson", {"Screened Poisson": 3e-5}),
        record("a", "poisson", {"Screened Poisson": 8e-5}, noise=0.01),
        record("a", "poisson-smoothed", {"Screened Poisson (our smoothing)": 5e-5}, noise=0.01),
    ]
    (table,) = poisson_tables(records)
    rows = rows_of(table)
    assert "clean, Screened Poisson (our smoothing)" not in rows
    assert rows["1 % noise, Screened Poisson (our smoothing)"]["mean CD"] == 5e-5
    assert rows["clean, Screened Poisson"]["mean CD"] == 3e-5
    assert rows["1 % noise, Ours fine"]["mean CD"] == 2e-5
    assert table.rows[1].published == (3.87e-5, 0.653, None, None)
    assert "is 3.00 times that of Ours fine on clean clouds, and 4.00 times under noise" in table.notes[0]
    assert "smoothed, screened Poisson is at 2.50 times ours" in table.notes[1]


def test_banf() -> None:
    records = [
        record("Armadillo_2", "ours", {"Ours coarse": 1.0, "Ours fine": 1e-5}),
        record("Armadillo_2", "banf", {"BANF 32": 1.0, "BANF 64": 2e-5}),
        record("Armadillo_2", "ours", {"Ours coarse": 1.0, "Ours fine": 3e-5}, noise=0.01),
        record("Armadillo_2", "banf", {"BANF 32": 1.0, "BANF 64": None}, noise=0.01),
    ]
    (table,) = banf_tables(records)
    (row,) = table.rows
    assert row.values == (1e-5, 2e-5, 3e-5, None, pytest.approx(3), None)
    assert row.published[:4] == BANF["armadillo"]
    assert row.published[5] == pytest.approx(7.3, abs=0.05)  # as the paper prints it


TABLE = Table(
    "made-up",
    "A table",
    "method",
    (Column("CD", ".1e", "lowest"), Column("IoU", ".2f", "highest"), Column("found")),
    (
        Row("first", (1e-5, 0.5, "1/1"), (2e-5, None, None), "A, B", "it | that"),
        Row("second", (3e-5, 0.75, "1/1")),
        Row("floor", (1e-6, None, None), competes=False),
    ),
    ("A note.",),
)


def test_markdown() -> None:
    lines = report.as_markdown(TABLE).splitlines()
    assert lines[0] == "| method | CD | IoU | found |"
    assert lines[2:] == [
        "| first | **1.0e-05** *(2.0e-05)* | 0.50 | 1/1 |",
        "| second | 3.0e-05 | **0.75** | 1/1 |",
        "| floor | 1.0e-06 | – | – |",
    ]


def test_csv() -> None:
    lines = list(csv.DictReader(io.StringIO(report.as_csv(TABLE))))
    assert [line["method"] for line in lines] == ["first", "second", "floor"]
    assert (float(lines[0]["CD"]), float(lines[0]["CD (paper)"])) == (1e-5, 2e-5)
    assert lines[1]["CD (paper)"] == lines[2]["IoU"] == ""
    assert (lines[0]["source"], lines[0]["differs"]) == ("A, B", "it | that")


def test_json_gives_the_same_table_back() -> None:
    assert report.from_dict(json.loads(json.dumps(report.as_dict(TABLE)))) == TABLE
    files = ((("p.svg", "P"),), (("s.png", "S"),), (("m", "s", "d"),), ("f",))
    section = report.Section("n", "l", "s", (TABLE,), *files)
    assert report.section_from_dict(json.loads(json.dumps(report.section_as_dict(section)))) == section


def test_rows_must_fit() -> None:
    for row, message in ((Row("r", (1,)), "t: r: 1 values for 2"), (Row("r", (1, 2), (1, 2, 3)), "3 values for 2")):
        with pytest.raises(ValueError, match=message):
            Table("t", "T", "h", (Column("a"), Column("b")), (row,))


def test_a_plot() -> None:
    plot = Plot("p", "A <b>", ("x", "y"), (Series("s", (1e-4, 1e-3)), Series("t", (None, 1e-1))), "CD", lines=True)
    svg = to_svg(plot)
    root = ElementTree.fromstring(svg)
    texts = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"A <b>", "x", "y", "s", "t", "CD"} <= set(texts)
    assert to_svg(plot) == svg
    dots = [dot for dot in root.iter("{http://www.w3.org/2000/svg}use") if "stroke-opacity" in dot.get("style", "")]
    (x0, y0), (x1, y1), (x2, y2), *legend = [(float(dot.attrib["x"]), float(dot.attrib["y"])) for dot in dots]
    assert len(legend) == 2
    assert x0 < x1 == x2
    assert y1 - y2 == pytest.approx(2 * (y0 - y1), abs=0.01)  # one decade up, then two


def test_plots_take_only_what_they_can_draw() -> None:
    for places, value, message in (
        (("x", "y"), 1.0, "1 values for 2"),
        (("x",), 0.0, "> 0"),
        (("x",), None, "no values"),
    ):
        with pytest.raises(ValueError, match=message):
            to_svg(Plot("p", "t", places, (Series("s", (value,)),), "CD"))
