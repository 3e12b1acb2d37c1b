"""The tables outliers, undertrained and deltas: where the paper says that it is weak, or that it is not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..harness.jobs import Record
from ..harness.plots import Plot, Series
from ..harness.tables import Column, Row, Table, Value, ratio
from .comparison import NOISE_LEVEL
from .jobs import PaperJob, TableSpec, figure, printed_name, select, shapes_of
from .judge import fit_config
from .published import DELTAS, OUTLIERS, UNDERTRAINED

if TYPE_CHECKING:
    from .jobs import Preset

CONTAMINATION = (0.001, 0.01, 0.05)  # the paper has the first two
FLIPPED = 0.1
OUTLIER_METHODS = ("ours", "poisson", "poisson-trim")
SHARES = (0.25, 0.5, 1.0)


def _outlier_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    strays = [
        PaperJob(shape, method, preset, outliers=fraction)
        for shape in shapes
        for fraction in CONTAMINATION
        for method in OUTLIER_METHODS
    ]
    flipped = [PaperJob(shape, method, preset, flipped=FLIPPED) for shape in shapes for method in ("ours", "poisson")]
    return strays + flipped


def outlier_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's outlier table, with 5 % as well, and normals that are turned round."""
    columns = (
        Column("ours IoU", ".3f"),
        Column("SPSR IoU", ".3f"),
        Column("SPSR (trim) IoU", ".3f"),
        Column("ours CD", ".2e"),
        Column("SPSR CD", ".2e"),
        Column("SPSR (trim) CD", ".2e"),
        Column("ours parts", ",d"),
    )
    rows = []
    for shape in shapes_of(records):
        for fraction in CONTAMINATION:
            some = select(records, shape=shape, outliers=fraction)
            per_method = [select(some, method=method) for method in OUTLIER_METHODS]
            values: tuple[Value, ...] = tuple(figure(found, "iou") for found in per_method)
            values += tuple(figure(found, "chamfer") for found in per_method)
            values += (figure(per_method[0], "components"),)
            printed = OUTLIERS.get((printed_name(shape, ("armadillo", "lucy")) or "", fraction))
            published = None if printed is None else (*printed, None, None, None, None)
            rows.append(Row(f"{shape} {100 * fraction:g} %", values, published))
    notes = [
        "Strays are uniform in the unit ball around the cloud, with random normals; their number is a fraction of the "
        "points. Results are measured against the clean surface.",
        "IoU is that of the volumes; the paper's is the overlap of surface voxels (`shell_iou` in the JSON files).",
    ]
    strays = select(records, method="ours", flipped=0.0)
    for fraction in CONTAMINATION:
        overlaps = {r["cell"]["shape"]: figure([r], "iou") for r in select(strays, outliers=fraction)}
        known = {shape: value for shape, value in overlaps.items() if value is not None}
        if known:
            worst = min(known, key=lambda shape: known[shape])
            notes.append(f"Lowest IoU of ours at {100 * fraction:g} %: {known[worst]:.3f}, of {worst}.")
    table = Table("outliers", "Strays", "cloud", columns, tuple(rows), tuple(notes))
    return (table, _flipped_table(records))


def _flipped_table(records: Sequence[Record]) -> Table:
    columns = (
        Column("ours IoU", ".3f"),
        Column("SPSR IoU", ".3f"),
        Column("ours CD", ".2e"),
        Column("SPSR CD", ".2e"),
        Column("ours parts", ",d"),
    )
    some = select(records, flipped=FLIPPED)
    rows = []
    for shape in shapes_of(some):
        found = [select(some, shape=shape, method=method) for method in ("ours", "poisson")]
        values = [figure(of, name) for name in ("iou", "chamfer") for of in found]
        rows.append(Row(shape, (*values, figure(found[0], "components"))))
    title = f"Normals of {100 * FLIPPED:g} % of the points turned round"
    return Table("outliers-flipped", title, "shape", columns, tuple(rows), ("Not in the paper.",))


def outlier_plots(records: Sequence[Record]) -> tuple[Plot, ...]:
    """Chamfer distance of ours against the share of strays, shape by shape."""
    strays = [record for record in select(records, method="ours", flipped=0.0) if record["cell"]["outliers"]]
    places = tuple(f"{100 * fraction:g} %" for fraction in CONTAMINATION)
    series = tuple(
        Series(shape, tuple(figure(select(strays, shape=shape, outliers=f), "chamfer") or None for f in CONTAMINATION))
        for shape in shapes_of(strays)
    )
    if not series:
        return ()
    title = "Chamfer distance of ours against the share of strays"
    return (Plot("outliers", title, places, series, "Chamfer distance", lines=True),)


def shortened(steps: Sequence[int], share: float) -> tuple[tuple[str, Any], ...]:
    """The override that trains the first level for a part of its steps; nothing for all of them.

    Example:
        >>> shortened((400, 300), 0.25)
        (('steps', (100, 300)),)
    """
    return () if share == 1 else (("steps", (max(round(share * steps[0]), 1), *steps[1:])),)


def _undertrained_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    steps = fit_config(preset).steps
    return [PaperJob(shape, "ours", preset, overrides=shortened(steps, share)) for shape in shapes for share in SHARES]


def undertrained_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's table of coarse stages trained for a part of their steps."""
    columns = (
        *(Column(f"δ₁ at {100 * share:g} %", ".2e") for share in SHARES),
        *(Column(f"CD at {100 * share:g} %", ".2e") for share in SHARES),
        Column("CD 25 % / 100 %", ".2f"),
    )
    rows = []
    for shape in shapes_of(records):
        of_shape = select(records, shape=shape)
        runs = [[r for r in of_shape if _share(r) == share] for share in SHARES]
        deltas = [found[0]["deltas"][0] if found and found[0]["deltas"] else None for found in runs]
        chamfers = [figure(found, "chamfer") for found in runs]
        name = printed_name(shape, ("armadillo", "lucy")) or ""
        printed = [UNDERTRAINED.get((name, share)) for share in SHARES]
        published = None
        if printed[0] is not None:
            known = [pair for pair in printed if pair is not None]
            published = (*(p[0] for p in known), *(p[1] for p in known), known[0][1] / known[-1][1])
        rows.append(Row(shape, (*deltas, *chamfers, ratio(chamfers[0], chamfers[-1])), published))
    factors = [row.values[-1] for row in rows if isinstance(row.values[-1], float)]
    notes = ["The first level is trained for a part of its steps, everything after it as always."]
    if factors:
        notes.insert(0, f"A coarse stage of 25 % costs at most a factor of {max(factors):.2f} in Chamfer distance.")
    title = "Coarse stage trained for a part of its steps"
    return (Table("undertrained", title, "shape", columns, tuple(rows), tuple(notes)),)


def _share(record: Record) -> float:
    """For which part of its steps a record's first level was trained."""
    full = fit_config(record["cell"]["preset"]).steps[0]
    steps = record["cell"]["overrides"].get("steps", [full])
    return min(SHARES, key=lambda share: abs(share - steps[0] / full))


def _delta_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    return [PaperJob(shape, "ours", preset, noise=noise) for shape in shapes for noise in (0.0, NOISE_LEVEL)]


def delta_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's table of measured band widths, clean and noisy."""
    count = max((len(record["deltas"]) for record in records), default=0)
    columns = tuple(Column(f"δ{_subscript(i + 1)}", ".2e") for i in range(count))
    rows = []
    for shape in shapes_of(records):
        for noise, words in ((0.0, ""), (NOISE_LEVEL, " + 1 % noise")):
            for record in select(records, shape=shape, noise=noise):
                deltas = [*record["deltas"], *[None] * count][:count]
                name = printed_name(shape, ("armadillo", "dragon", "lucy", "thai")) or ""
                printed = DELTAS.get((name, noise))
                published = None if printed is None or count != len(printed) else printed
                rows.append(Row(shape + words, tuple(deltas), published))
    widths = [delta for record in records for delta in record["deltas"]]
    notes = ["Half-widths of the bands in the unit sphere; see docs/fit.md for what ours leaves out of Eq. 5."]
    if widths:
        notes.insert(0, f"The widest band is {100 * max(widths):.2f} % of the unit sphere's radius.")
    return (Table("deltas", "Measured band widths", "cloud", columns, tuple(rows), tuple(notes)),)


def _subscript(number: int) -> str:
    return "".join(chr(0x2080 + int(digit)) for digit in str(number))


OUTLIERS_TABLE = TableSpec(
    "outliers",
    "tab:outliers",
    "strays and flipped normals",
    _outlier_jobs,
    outlier_tables,
    outlier_plots,
    sheets=True,
)
UNDERTRAINED_TABLE = TableSpec(
    "undertrained", "tab:undertrained", "short coarse stages", _undertrained_jobs, undertrained_tables
)
DELTAS_TABLE = TableSpec("deltas", "tab:deltas", "measured band widths", _delta_jobs, delta_tables)
