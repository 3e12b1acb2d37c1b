"""The tables comparison, noise, poisson and banf: ours and its peers, on clean clouds and on noisy ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..harness.jobs import Record
from ..harness.plots import Plot, Series
from ..harness.tables import Column, Figure, Row, Table, Value, mean, median, ratio, tabulated
from .jobs import PaperJob, TableSpec, by_shape, figure, of_output, outputs_of, printed_name, select, shapes_of
from .names import METHODS
from .published import BANF, COMPARISON, NOISE, POISSON

if TYPE_CHECKING:
    from .jobs import Preset

NOISE_LEVEL = 0.01  # of the bounding box's diagonal (paper, Tab. 3)
CURVE = (0.005, 0.02)  # and what the noise curves have beside it, for these:
CURVE_METHODS = ("ours", "poisson")
VARIANTS = ("poisson-trim", "poisson-smoothed")  # of a peer, in its own table only:
POISSONS = ("Screened Poisson (1% trim)", "Screened Poisson", "Screened Poisson (our smoothing)")
FRAME = 512 * 512  # pixels of the paper's frames

FOUND = "A row's means are over the shapes on which the method found a surface; `found` counts them."
SHELL = (
    "`shell IoU` is the overlap of the surface voxels of size 0.01, which is what the paper's code measures; "
    "`IoU` is that of the volumes."
)


def _methods(names: Iterable[str]) -> list[str]:
    return [name for name in METHODS if name in names]


def _comparison_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    peers = [name for name in METHODS if name not in VARIANTS]
    return [PaperJob(shape, method, preset) for shape in shapes for method in peers]


def _noise_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    peers = [name for name in METHODS if name not in VARIANTS]
    jobs = [PaperJob(shape, method, preset, noise=NOISE_LEVEL) for shape in shapes for method in peers]
    more = [
        PaperJob(shape, method, preset, noise=noise)
        for shape in shapes
        for method in _methods(CURVE_METHODS)
        for noise in (0.0, *CURVE)
    ]
    return jobs + more


def _poisson_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    jobs = [
        PaperJob(shape, method, preset, noise=noise)
        for shape in shapes
        for method in ("poisson-trim", "poisson", "ours")
        for noise in (0.0, NOISE_LEVEL)
    ]
    return jobs + [PaperJob(shape, "poisson-smoothed", preset, noise=NOISE_LEVEL) for shape in shapes]


def _banf_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    return [
        PaperJob(shape, method, preset, noise=noise)
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


def _quality(records: Sequence[Record]) -> list[Figure[str]]:
    """Means and medians of an output over the shapes."""

    def of(figure: str, average: Callable[[Iterable[float | None]], float | None]) -> Callable[[str], float | None]:
        return lambda output: average(of_output(records, output, figure))

    def found(output: str) -> str:
        values = of_output(records, output, "chamfer")
        return f"{sum(value is not None for value in values)}/{len(values)}"

    return [
        (Column("mean CD", ".2e", "lowest"), of("chamfer", mean)),
        (Column("median CD", ".2e", "lowest"), of("chamfer", median)),
        (Column("mean shell IoU", ".3f", "highest"), of("shell_iou", mean)),
        (Column("median shell IoU", ".3f", "highest"), of("shell_iou", median)),
        (Column("mean IoU", ".3f", "highest"), of("iou", mean)),
        (Column("mean parts", ".1f"), of("components", mean)),
        (Column("found"), found),
    ]


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

    def average(name: str, per: float = 1) -> Callable[[str], float | None]:
        return lambda output: ratio(mean(of_output(records, output, name)), per)

    def published(output: str) -> tuple[Value, ...] | None:
        printed = COMPARISON.get(output)
        return None if printed is None else (*printed[:4], None, None, None, *printed[4:])

    figures: list[Figure[str]] = [
        *_quality(records),
        (Column("parameters", ",d", "lowest"), lambda output: _most(of_output(records, output, "parameters"))),
        (Column("training (min)", ".2f", "lowest"), average("train_seconds", per=60)),
        (Column("meshing (s)", ".2f", "lowest"), average("mesh_seconds")),
        (Column("FPS at 512²", ".2f", "highest"), average("rays_per_second", per=FRAME)),
    ]
    notes = (
        *_reading(records),
        FOUND,
        SHELL,
        "FPS: sphere tracing with 20 steps on the first level and 5 on each finer one, no normals, measured at a "
        "smaller size and scaled by the number of pixels. The paper's seconds and FPS are of an RTX 5090.",
    )
    title = "Surface reconstruction of clean clouds"
    return (_of_outputs("comparison", title, records, figures, published, notes), *_per_shape("comparison", records))


def noise_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's Tab. 3, and the figures of every shape behind it."""
    noisy = select(records, noise=NOISE_LEVEL)
    notes = (
        *_reading(noisy),
        "Points are moved along their normals by up to 1 % of the bounding box's diagonal; results are measured "
        "against the clean surface.",
        FOUND,
        SHELL,
    )
    title = "Surface reconstruction under 1 % noise"
    return (_of_outputs("noise", title, noisy, _quality(noisy), NOISE.get, notes), *_per_shape("noise", noisy))


def _of_outputs(
    name: str,
    title: str,
    records: Sequence[Record],
    figures: Sequence[Figure[str]],
    published: Callable[[str], tuple[Value, ...] | None],
    notes: Iterable[str],
) -> Table:
    """One row per output, and what a perfect mesh would score."""
    return tabulated(
        name,
        title,
        "method",
        figures,
        [(output, output) for output in outputs_of(records)],
        published=published,
        about=lambda output: _source(records, output),
        more=[_floor_row(records, len(figures))],
        notes=notes,
    )


def _per_shape(name: str, records: Sequence[Record]) -> list[Table]:
    """Chamfer distance, IoU and number of parts of every output on every shape."""

    def of(shape: str, figure: str) -> Callable[[str], float | None]:
        return lambda output: by_shape(records, output, figure).get(shape)

    items = [(output, output) for output in outputs_of(records)]
    tables = []
    for what, title, column in (
        ("chamfer", "Chamfer distance", Column("", ".2e", "lowest")),
        ("iou", "IoU of the volumes", Column("", ".3f", "highest")),
        ("components", "connected parts", Column("", ",d")),
    ):
        figures: list[Figure[str]] = [(replace(column, name=shape), of(shape, what)) for shape in shapes_of(records)]
        tables.append(tabulated(f"{name}-{what}", f"Per shape: {title}", "method", figures, items))
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

    def of(figure: str) -> Callable[[tuple[str, float]], float | None]:
        return lambda row: mean(of_output(select(records, noise=row[1]), row[0], figure))

    figures: list[Figure[tuple[str, float]]] = [
        (Column("mean CD", ".2e", "lowest"), of("chamfer")),
        (Column("mean shell IoU", ".3f", "highest"), of("shell_iou")),
        (Column("mean IoU", ".3f", "highest"), of("iou")),
        (Column("mean parts", ".1f"), of("components")),
    ]
    items = [
        (f"{words}, {output}", (output, noise))
        for noise, words in ((0.0, "clean"), (NOISE_LEVEL, "1 % noise"))
        for output in (*POISSONS, "Ours fine")
        if output in outputs_of(select(records, noise=noise))
    ]

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
    table = tabulated(
        "poisson",
        "Screened Poisson",
        "setting",
        figures,
        items,
        published=POISSON.get,
        about=lambda row: _source(select(records, noise=row[1]), row[0]),
        notes=notes,
    )
    return (table,)


def banf_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's comparison with BANF: clean, noisy, and what noise costs."""

    def chamfer(method: str, noise: float) -> Callable[[str], float | None]:
        return lambda shape: figure(select(records, noise=noise, shape=shape, method=method), "chamfer")

    def degradation(method: str) -> Callable[[str], float | None]:
        return lambda shape: ratio(chamfer(method, NOISE_LEVEL)(shape), chamfer(method, 0.0)(shape))

    def published(shape: str) -> tuple[Value, ...] | None:
        printed = BANF.get(printed_name(shape, BANF) or "")
        return None if printed is None else (*printed, printed[2] / printed[0], printed[3] / printed[1])

    figures: list[Figure[str]] = [
        (Column("ours clean", ".2e"), chamfer("ours", 0.0)),
        (Column("BANF clean", ".2e"), chamfer("banf", 0.0)),
        (Column("ours noise", ".2e"), chamfer("ours", NOISE_LEVEL)),
        (Column("BANF noise", ".2e"), chamfer("banf", NOISE_LEVEL)),
        (Column("ours degr.", ".1f"), degradation("ours")),
        (Column("BANF degr.", ".1f"), degradation("banf")),
    ]
    items = [(shape, shape) for shape in shapes_of(records)]
    notes = (
        "Chamfer distance of the finest level of each; `degr.` is that under 1 % noise over that on the clean cloud.",
        "The paper's BANF is a re-implementation as well: the authors' code has no reconstruction from points.",
    )
    return (tabulated("banf", "BANF", "shape", figures, items, published=published, notes=notes),)


COMPARISON_TABLE = TableSpec(
    "comparison",
    "t-comparison",
    "every method on clean clouds",
    _comparison_jobs,
    comparison_tables,
    lambda records: _per_mesh_plots("comparison", "clean", records),
    sheets=True,
)
NOISE_TABLE = TableSpec(
    "noise",
    "table:noise_comparison",
    "every method on clouds with 1 % noise",
    _noise_jobs,
    noise_tables,
    noise_plots,
    sheets=True,
)
POISSON_TABLE = TableSpec("poisson", "tab:spsr", "screened Poisson, clean and noisy", _poisson_jobs, poisson_tables)
BANF_TABLE = TableSpec("banf", "tab:banf", "BANF, clean and noisy", _banf_jobs, banf_tables)
