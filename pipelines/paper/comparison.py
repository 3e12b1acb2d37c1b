"""The tables comparison, noise, poisson and banf: ours and its peers, on clean clouds and on noisy ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..bench.cells import Record
from ..bench.plots import Plot, Series
from ..bench.tables import Column, Row, Table, Value, mean, median, ratio
from .cells import PaperCell, TableSpec, by_shape, figure, of_output, outputs_of, printed_name, select, shapes_of
from .names import METHODS
from .published import BANF, COMPARISON, NOISE, POISSON

if TYPE_CHECKING:
    from .cells import Preset

__all__ = ["BANF_TABLE", "COMPARISON_TABLE", "NOISE_TABLE", "POISSON_TABLE"]

NOISE_LEVEL = 0.01  # of the bounding box's diagonal (paper, Tab. 3)
CURVE = (0.005, 0.02)  # and what the noise curves have beside it, for these:
CURVE_METHODS = ("ours", "poisson")
VARIANTS = ("poisson-trim", "poisson-smoothed")  # of a peer, in its own table only:
POISSONS = ("Screened Poisson (1% trim)", "Screened Poisson", "Screened Poisson (our smoothing)")
FRAME = 512 * 512  # pixels of the paper's frames

CHAMFER = Column("Chamfer", ".2e", "lowest")
FOUND = "A row's means are over the shapes on which the method found a surface; `found` counts them."
SHELL = (
    "`shell IoU` is the overlap of the surface voxels of size 0.01, which is what the paper's code measures; "
    "`IoU` is that of the volumes."
)


def _methods(names: Iterable[str]) -> list[str]:
    return [name for name in METHODS if name in names]


def _comparison_cells(shapes: Sequence[Path], preset: Preset) -> list[PaperCell]:
    peers = [name for name in METHODS if name not in VARIANTS]
    return [PaperCell(shape, method, preset) for shape in shapes for method in peers]


def _noise_cells(shapes: Sequence[Path], preset: Preset) -> list[PaperCell]:
    peers = [name for name in METHODS if name not in VARIANTS]
    cells = [PaperCell(shape, method, preset, noise=NOISE_LEVEL) for shape in shapes for method in peers]
    more = [
        PaperCell(shape, method, preset, noise=noise)
        for shape in shapes
        for method in _methods(CURVE_METHODS)
        for noise in (0.0, *CURVE)
    ]
    return cells + more


def _poisson_cells(shapes: Sequence[Path], preset: Preset) -> list[PaperCell]:
    cells = [
        PaperCell(shape, method, preset, noise=noise)
        for shape in shapes
        for method in ("poisson-trim", "poisson", "ours")
        for noise in (0.0, NOISE_LEVEL)
    ]
    return cells + [PaperCell(shape, "poisson-smoothed", preset, noise=NOISE_LEVEL) for shape in shapes]


def _banf_cells(shapes: Sequence[Path], preset: Preset) -> list[PaperCell]:
    return [
        PaperCell(shape, method, preset, noise=noise)
        for shape in shapes
        for method in ("ours", "banf")
        for noise in (0.0, NOISE_LEVEL)
    ]


def _source(records: Sequence[Record], output: str) -> tuple[str, str]:
    """Of the method that an output belongs to."""
    for record in records:
        if any(found["name"] == output for found in record["outputs"]):
            return record["method"]["source"], record["method"]["differs"]
    return "", ""


def _quality(records: Sequence[Record], output: str) -> tuple[Value, ...]:
    """Means and medians of an output over the shapes."""
    chamfer, shell, volume = (of_output(records, output, name) for name in ("chamfer", "shell_iou", "iou"))
    found = sum(value is not None for value in chamfer)
    values = (mean(chamfer), median(chamfer), mean(shell), median(shell), mean(volume))
    parts = mean(of_output(records, output, "components"))
    return (*values, parts, f"{found}/{len(chamfer)}")


QUALITY = (
    Column("mean CD", ".2e", "lowest"),
    Column("median CD", ".2e", "lowest"),
    Column("mean shell IoU", ".3f", "highest"),
    Column("median shell IoU", ".3f", "highest"),
    Column("mean IoU", ".3f", "highest"),
    Column("mean parts", ".1f"),
    Column("found"),
)


def _floor_row(records: Sequence[Record], columns: int) -> Row:
    """What a perfect mesh would score."""
    floors = {
        record["cell"]["shape"]: output["chamfer_floor"]
        for record in records
        for output in record["outputs"]
        if output.get("chamfer_floor") is not None
    }
    values = (mean(floors.values()), median(floors.values()))
    return Row("(sampling floor)", values + (None,) * (columns - 2), competes=False)


def _most(values: Iterable[float | None]) -> int | None:
    numbers = [int(value) for value in values if value is not None]
    return max(numbers, default=None)


def _reading(records: Sequence[Record]) -> list[str]:
    """What the mean Chamfer distances say, in a sentence; the fine level of ours against the best of the others."""
    means = {name: mean(of_output(records, name, "chamfer")) for name in outputs_of(records)}
    others = {name: value for name, value in means.items() if value is not None and not name.startswith("Ours")}
    ours = means.get("Ours fine")
    if ours is None or not others:
        return []
    best = min(others, key=lambda name: others[name])
    factor = others[best] / ours
    words = f"{factor:.2f} times lower than" if factor >= 1 else f"{1 / factor:.2f} times higher than"
    text = f"The mean Chamfer distance of Ours fine is {words} that of the best other row, {best}"
    poisson = others.get("Screened Poisson")
    if poisson is not None and best != "Screened Poisson":
        text += f", and {poisson / ours:.2f} times below that of screened Poisson"
    return [text + "."]


def comparison_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's Tab. 2, and the figures of every shape behind it."""
    columns = (
        *QUALITY,
        Column("parameters", ",d", "lowest"),
        Column("training (min)", ".2f", "lowest"),
        Column("meshing (s)", ".2f", "lowest"),
        Column("FPS at 512²", ".2f", "highest"),
    )
    rows = []
    for name in outputs_of(records):
        rays = mean(of_output(records, name, "rays_per_second"))
        minutes = mean(of_output(records, name, "train_seconds"))
        values = (
            *_quality(records, name),
            _most(of_output(records, name, "parameters")),
            None if minutes is None else minutes / 60,
            mean(of_output(records, name, "mesh_seconds")),
            None if rays is None else rays / FRAME,
        )
        printed = COMPARISON.get(name)
        published = None
        if printed is not None:
            published = (*printed[:4], None, None, None, *printed[4:])
        rows.append(Row(name, values, published, *_source(records, name)))
    rows.append(_floor_row(records, len(columns)))
    notes = (
        *_reading(records),
        FOUND,
        SHELL,
        "FPS: sphere tracing with 20 steps on the first level and 5 on each finer one, no normals, measured at a "
        "smaller size and scaled by the number of pixels. The paper's seconds and FPS are of an RTX 5090.",
    )
    table = Table("comparison", "Surface reconstruction of clean clouds", "method", columns, tuple(rows), notes)
    return (table, *_per_shape("comparison", records))


def noise_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's Tab. 3, and the figures of every shape behind it."""
    noisy = select(records, noise=NOISE_LEVEL)
    rows = []
    for name in outputs_of(noisy):
        printed = NOISE.get(name)
        published = None if printed is None else (*printed, None, None, None)
        rows.append(Row(name, _quality(noisy, name), published, *_source(noisy, name)))
    rows.append(_floor_row(noisy, len(QUALITY)))
    notes = (
        *_reading(noisy),
        "Points are moved along their normals by up to 1 % of the bounding box's diagonal; results are measured "
        "against the clean surface.",
        FOUND,
        SHELL,
    )
    table = Table("noise", "Surface reconstruction under 1 % noise", "method", QUALITY, tuple(rows), notes)
    return (table, *_per_shape("noise", noisy))


def _per_shape(name: str, records: Sequence[Record]) -> list[Table]:
    """Chamfer distance, IoU and number of parts of every output on every shape."""
    outputs = outputs_of(records)
    tables = []
    for what, title, column in (
        ("chamfer", "Chamfer distance", CHAMFER),
        ("iou", "IoU of the volumes", Column("IoU", ".3f", "highest")),
        ("components", "connected parts", Column("parts", ",d")),
    ):
        rows = []
        for output in outputs:
            values = by_shape(records, output, what)
            rows.append(Row(output, tuple(values.get(shape) for shape in shapes_of(records))))
        columns = tuple(Column(shape, column.form, column.best) for shape in shapes_of(records))
        tables.append(Table(f"{name}-{what}", f"Per shape: {title}", "method", columns, tuple(rows)))
    return tables


PAIRS = (
    ("Ours coarse", "iNGP coarse"),
    ("Ours fine", "iNGP fine"),
    ("Ours fine", "BACON"),
    ("Ours fine", "IDF"),
    ("Ours fine", "Screened Poisson"),
)


def _series(records: Sequence[Record], output: str) -> Series:
    values = by_shape(records, output, "chamfer")
    return Series(output, tuple(values.get(shape) or None for shape in shapes_of(records)))


def _per_mesh_plots(name: str, what: str, records: Sequence[Record]) -> tuple[Plot, ...]:
    """Chamfer distance per mesh, as in the paper's supplement: all outputs, the levels of ours, and pairs."""
    outputs, places = outputs_of(records), tuple(shapes_of(records))
    if not places:
        return ()
    levels = tuple(output for output in outputs if output.startswith("Ours"))
    groups = [("all", tuple(outputs), "every method"), ("levels", levels, "each level of ours")]
    groups += [
        ("-".join(pair).lower().replace(" ", "-"), pair, " and ".join(pair))
        for pair in PAIRS
        if set(pair) <= set(outputs)
    ]
    return tuple(
        Plot(
            f"{name}-per-mesh-{slug}",
            f"Chamfer distance per mesh, {what}: {title}",
            places,
            tuple(_series(records, output) for output in members),
            "Chamfer distance",
        )
        for slug, members, title in groups
        if members
    )


def noise_plots(records: Sequence[Record]) -> tuple[Plot, ...]:
    """Per mesh at 1 % noise, and the mean Chamfer distance against the noise."""
    noisy = select(records, noise=NOISE_LEVEL)
    amplitudes = sorted({record["cell"]["noise"] for record in records})
    series = []
    for output in outputs_of(records):
        values = tuple(mean(of_output(select(records, noise=a), output, "chamfer")) or None for a in amplitudes)
        if sum(value is not None for value in values) > 1:
            series.append(Series(output, values))
    places = tuple(f"{100 * amplitude:g} %" for amplitude in amplitudes)
    curves = Plot(
        "noise-curves", "Mean Chamfer distance against noise", places, tuple(series), "Chamfer distance", lines=True
    )
    return (*([curves] if series else []), *_per_mesh_plots("noise", "1 % noise", noisy))


def poisson_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's comparison with screened Poisson."""
    columns = (
        Column("mean CD", ".2e", "lowest"),
        Column("mean shell IoU", ".3f", "highest"),
        Column("mean IoU", ".3f", "highest"),
        Column("mean parts", ".1f"),
    )
    rows = []
    for noise, words in ((0.0, "clean"), (NOISE_LEVEL, "1 % noise")):
        some = select(records, noise=noise)
        for output in (*POISSONS, "Ours fine"):
            if output not in outputs_of(some):
                continue
            figures = ("chamfer", "shell_iou", "iou", "components")
            values = tuple(mean(of_output(some, output, name)) for name in figures)
            printed = POISSON.get((output, noise))
            published = None if printed is None else (*printed, None, None)
            rows.append(Row(f"{words}, {output}", values, published, *_source(some, output)))

    def factor(output: str, noise: float) -> float | None:
        some = select(records, noise=noise)
        return ratio(mean(of_output(some, output, "chamfer")), mean(of_output(some, "Ours fine", "chamfer")))

    clean, noisy = factor("Screened Poisson", 0.0), factor("Screened Poisson", NOISE_LEVEL)
    smoothed = factor("Screened Poisson (our smoothing)", NOISE_LEVEL)
    notes = []
    if clean is not None and noisy is not None:
        notes.append(
            f"The mean Chamfer distance of screened Poisson without trim is {clean:.2f} times that of Ours fine "
            f"on clean clouds, and {noisy:.2f} times under noise."
        )
    if smoothed is not None:
        notes.append(f"Given the cloud that ours has smoothed, screened Poisson is at {smoothed:.2f} times ours.")
    notes.append(SHELL)
    return (Table("poisson", "Screened Poisson", "setting", columns, tuple(rows), tuple(notes)),)


def banf_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's comparison with BANF: clean, noisy, and what noise costs."""
    columns = (
        Column("ours clean", ".2e"),
        Column("BANF clean", ".2e"),
        Column("ours noise", ".2e"),
        Column("BANF noise", ".2e"),
        Column("ours degr.", ".1f"),
        Column("BANF degr.", ".1f"),
    )
    clean, noisy = (select(records, noise=noise) for noise in (0.0, NOISE_LEVEL))
    rows = []
    for shape in shapes_of(records):
        values = [
            figure(select(some, shape=shape, method=method), "chamfer")
            for some in (clean, noisy)
            for method in ("ours", "banf")
        ]
        printed = BANF.get(printed_name(shape, BANF) or "")
        published = None if printed is None else (*printed, printed[2] / printed[0], printed[3] / printed[1])
        rows.append(Row(shape, (*values, ratio(values[2], values[0]), ratio(values[3], values[1])), published))
    notes = (
        "Chamfer distance of the finest level of each; `degr.` is that under 1 % noise over that on the clean cloud.",
        "The paper's BANF is a re-implementation as well: the authors' code has no reconstruction from points.",
    )
    return (Table("banf", "BANF", "shape", columns, tuple(rows), notes),)


COMPARISON_TABLE = TableSpec(
    "comparison",
    "t-comparison",
    "every method on clean clouds",
    _comparison_cells,
    comparison_tables,
    lambda records: _per_mesh_plots("comparison", "clean", records),
    sheets=True,
)
NOISE_TABLE = TableSpec(
    "noise",
    "table:noise_comparison",
    "every method on clouds with 1 % noise",
    _noise_cells,
    noise_tables,
    noise_plots,
    sheets=True,
)
POISSON_TABLE = TableSpec("poisson", "tab:spsr", "screened Poisson, clean and noisy", _poisson_cells, poisson_tables)
BANF_TABLE = TableSpec("banf", "tab:banf", "BANF, clean and noisy", _banf_cells, banf_tables)
