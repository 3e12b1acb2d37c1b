"""``mplicits fit``: its arguments, those about depth maps among them, and the checks before any work."""

from __future__ import annotations

import argparse
import math
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..training.settings import FitConfig, command_line, given_flags, input_error
from .common import (
    Command,
    add_new_run,
    add_settings,
    new_settings,
    positive,
    refuse,
    stoppable,
    tell_budget,
    training,
    whole,
)
from .train import tell_texture

if TYPE_CHECKING:
    from ...neural_fields import Mesh
    from ..fit.depth import DepthInput
    from ..fit.many import FitOutcome

DEPTH_FLAGS = (
    *("intrinsics", "fov", "color", "resize_color", "poses"),
    *("depth_scale", "inverse_depth", "max_depth", "max_points", "smooth_depth"),
)


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    what = (
        "PLY, PCD, E57, OBJ, STL, OFF, XYZ, TXT, ASC, CSV, PTS, NPY, NPZ, LAS or LAZ; a depth map, or a folder of them"
    )
    add("clouds", nargs="+", metavar="CLOUD", help=f"{what}; several clouds get a run each, RUN/NAME")
    add_new_run(parser, "directory of the run, or runs")
    add("--jobs", type=whole(1), metavar="N", help="several clouds: fits at a time; above 1 needs mplicits[ray]")
    add(
        "--tiles", choices=["auto"], help="cut a cloud that one network cannot hold into tiles, by its number of points"
    )
    add("--tile-size", type=positive, metavar="LENGTH", help="cut it into tiles with edges of this length, in its unit")
    add("--ray-address", metavar="ADDRESS", help="of a Ray cluster whose machines share RUN: fit tiles there")
    what = "then learn the colours, if there are any, and write the mesh (.ply, .obj, .stl, .glb)"
    add("--mesh", type=Path, metavar="FILE", help=what)
    add("--no-colors", action="store_true", help="leave the colours out of --mesh")
    add("--watch", action="store_true", help="show the growing field in the browser, checkpoint by checkpoint")
    add_settings(parser, FitConfig)
    add = parser.add_argument_group("depth maps (PNG, TIFF, NPY or NPZ, or a folder of them)").add_argument
    what = "camera JSON (ours, or Open3D's), or four numbers in pixels: FX FY CX CY"
    add("--intrinsics", nargs="+", metavar="FILE|NUMBER", help=what)
    add("--fov", type=positive, metavar="DEGREES", help="vertical angle of view, if no more is known")
    add("--color", type=Path, metavar="FILE|DIR", help="the picture, or a folder of one per depth map")
    add("--resize-color", action="store_true", help="scale pictures to the size of the depth maps")
    add("--poses", type=Path, metavar="FILE", help="of several depth maps: Open3D's trajectory.log, or transforms.json")
    what = "numbers per unit (integers: as the camera says, or 1000; else 1)"
    add("--depth-scale", type=positive, metavar="N", help=what)
    add("--inverse-depth", action="store_true", help="the numbers are disparities: z = scale / number")
    add("--max-depth", "--depth-max", type=positive, metavar="Z", help="drop what is further away than this")
    add("--max-points", type=whole(1), metavar="N", help="thin the cloud to as many (200000)")
    what = "radius of smoothing (as the noise asks for; 0: none)"
    add("--smooth-depth", type=whole(0, 16), metavar="PIXELS", help=what)


def _fit(arguments: argparse.Namespace) -> int:
    config = new_settings(arguments, FitConfig)
    if arguments.mesh is None:
        refuse(arguments, ["no_colors"], "is about --mesh FILE; leave it out, or add that")
    tiled = arguments.tiles is not None or arguments.tile_size is not None
    if arguments.resume and not tiled:
        from ..fit.tiles import PLAN_FILE

        tiled = (arguments.out / PLAN_FILE).is_file()
    if tiled:
        return _fit_tiles(arguments, config)
    refuse(arguments, ["ray_address"], "is for tiles; add --tiles auto, or leave it out")
    if len(arguments.clouds) > 1 or arguments.jobs is not None:
        return _fit_many(arguments, config)
    return _fit_one(arguments, arguments.clouds[0], config)


def _fit_one(arguments: argparse.Namespace, cloud: str, config: FitConfig | None) -> int:
    from ...neural_fields.backend.devices import peak_memory
    from ..fit.depth import fit_depth, trim_suggestion
    from ..fit.train import fit
    from ..training.folder import TEXTURE_FILE, check_new_run, is_fitted, read_record

    directory, depth = arguments.out, _depth_input(arguments, cloud)
    # A run that was interrupted after its fit goes on there.
    fitted = arguments.resume and arguments.mesh is not None and is_fitted(directory)
    if not fitted:
        check_new_run(directory, resume=arguments.resume, force=arguments.force)
    columns = read_record(directory)["config"].get("columns") if config is None else config.columns
    mesh = None
    if arguments.mesh is not None:
        from ..mesh.finish import plan_mesh

        options = {"columns": columns, "colors": not arguments.no_colors, "resume": arguments.resume}
        mesh = plan_mesh(arguments.mesh, directory, Path(cloud) if depth is None else depth, **options)
    then = () if mesh is None else ("--mesh", mesh.out, *["--no-colors"] * arguments.no_colors)
    again = f"to continue: {command_line('fit', cloud, '-o', directory, '--resume', *then)}"
    texture, made, said, started = None, None, list[str](), time.monotonic()
    watch: AbstractContextManager[object] = nullcontext()
    if arguments.watch:
        from ..web.watch import Watcher

        watch = Watcher(directory, resume=arguments.resume, say=lambda line: print(line, file=sys.stderr))
    with watch, training(again, quiet=arguments.quiet, board=arguments.tensorboard) as report:
        if not fitted and depth is None:
            fit(cloud, config, out=directory, resume=arguments.resume, progress=report)
        elif not fitted and depth is not None:
            fit_depth(depth, config, out=directory, resume=arguments.resume, progress=report, say=print)
        if mesh is not None:
            texture = mesh.texture(refit=not fitted, progress=report)
            if texture is None or texture.record["finished"]:
                with stoppable(f"fit and texture are finished; {again}", at_any_time=True):
                    made = mesh.extract(say=said.append, progress=report)
    tell_budget(read_record(directory))
    print(describe(directory))
    if (memory := peak_memory()) is not None:
        print(f"  peak memory  {memory / 2**20:,.0f} MiB")
    # A depth map shows one side of things; what the fit closes behind it is no part of them.
    trim = [] if depth is None else ["--trim-distance", f"{trim_suggestion(directory):.2g}"]
    if mesh is None:
        print("next:", command_line("mesh", directory, "-o", directory / "mesh.ply", *trim))
        return 0
    if texture is not None:
        tell_texture(directory / TEXTURE_FILE, texture, again)
    assert made is not None
    print("\n".join(said), end="\n" * bool(said))
    facts = [f"{len(made.vertices):,} vertices", f"{len(made.faces):,} faces"]
    facts += ["with colours"] * mesh.colored + ([" ".join(trim)] if trim else [])
    print(f"{mesh.out}: {', '.join(facts)}, {time.monotonic() - started:.1f} s in all")
    return 0


def _fit_many(arguments: argparse.Namespace, config: FitConfig | None) -> int:
    """A run for each cloud; a failed one leaves the others alone, and exit code 1."""
    refuse(arguments, ["watch", "tensorboard"], "is for one cloud; fit them one by one, without --jobs")
    refuse(arguments, ["mesh"], "is for one cloud; leave it out, and mesh the runs afterwards")
    for cloud in arguments.clouds:
        if _depth_input(arguments, cloud) is not None:
            raise input_error(f"{cloud}: holds depth maps; fit them on their own, without --jobs")
    from ..fit.many import fit_many, format_fits, plan_fits
    from ..training.jobs import check_jobs

    jobs = arguments.jobs or 1
    check_jobs(jobs)
    planned = plan_fits(arguments.clouds, arguments.out, config, resume=arguments.resume, force=arguments.force)
    again = command_line("fit", *arguments.clouds, "-o", arguments.out, "--jobs", jobs, "--resume")
    with training(f"to continue: {again}", quiet=arguments.quiet or jobs > 1, at_any_time=True) as show:
        outcomes = fit_many(
            planned,
            arguments.out,
            jobs=jobs,
            progress=None if show is None else lambda name, step: show(replace(step, stage=f"{name} {step.stage}")),
            report=None if arguments.quiet or jobs == 1 else _Tally(len(planned)),
        )
    print(format_fits(outcomes))
    return int(any(outcome.error is not None for outcome in outcomes))


def _fit_tiles(arguments: argparse.Namespace, config: FitConfig | None) -> int:
    """One cloud in tiles."""
    refuse(arguments, ["watch", "tensorboard", "mesh"], "does not go with tiles; leave it out")
    if len(arguments.clouds) > 1:
        raise input_error(f"{arguments.clouds[1]}: tiles are of one cloud; name only one")
    cloud = arguments.clouds[0]
    if _depth_input(arguments, cloud) is not None:
        raise input_error(f"{cloud}: holds depth maps, which are not cut into tiles; leave out --tiles")
    from ..fit.tiles import fit_tiles, plan_fit
    from ..training.folder import check_new_run
    from ..training.jobs import check_jobs

    jobs, address = arguments.jobs or 1, arguments.ray_address
    check_jobs(jobs, address)
    check_new_run(arguments.out, resume=False, force=arguments.force or arguments.resume)
    more = ("--jobs", jobs) * (jobs > 1) + ("--ray-address", address) * (address is not None)
    again = command_line("fit", cloud, "-o", arguments.out, *more, "--resume")
    with training(f"to continue: {again}", quiet=arguments.quiet, at_any_time=True) as show:
        report = show or (lambda _: None)
        job = plan_fit(cloud, arguments.out, config, size=arguments.tile_size, resume=arguments.resume, report=report)
        alone = show is not None and jobs == 1 and address is None
        run = fit_tiles(
            job,
            jobs=jobs,
            address=address,
            progress=(lambda name, step: report(replace(step, stage=f"tile {name} {step.stage}"))) if alone else None,
            report=None if arguments.quiet else _Tally(job.plan.num_tiles),
        )
    print(describe(arguments.out))
    if opposed := run.record["seams"]["opposed"]:
        print(f"warning: {opposed} pairs of tiles oppose each other; look at them", file=sys.stderr)
    print("next:", command_line("mesh", arguments.out, "-o", arguments.out / "mesh.ply", "--resolution", 1024))
    return 0


class _Tally:
    """Says what became of each fit, and how long the others will take."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self.started = total, 0, time.monotonic()

    def __call__(self, outcome: FitOutcome) -> None:
        """Count one fit."""
        from ..training.progress import time_words

        self.done += 1
        left = time_words((time.monotonic() - self.started) / self.done * (self.total - self.done))
        result = f"fitted after {outcome.seconds:.1f} s" if outcome.error is None else outcome.error
        place = f"{self.done} of {self.total}" + f", about {left} left" * (self.done < self.total)
        print(f"{outcome.item.cloud.stem}: {result}; {place}", file=sys.stderr)


def _depth_input(arguments: argparse.Namespace, cloud: str) -> DepthInput | None:
    """The depth maps that the arguments name; None if CLOUD is a cloud, which flags of depth maps do not go with."""
    from ...datasets import DepthSettings, is_depth_file
    from ...datasets.files import DEPTH_SUFFIXES
    from ..fit.depth import DepthInput

    path, given = Path(cloud), any(getattr(arguments, name) not in (None, False) for name in DEPTH_FLAGS)
    if not (path.suffix.lower() in DEPTH_SUFFIXES or path.is_dir()):
        known = ", ".join(DEPTH_SUFFIXES)
        refuse(arguments, DEPTH_FLAGS, f"is for depth maps ({known}, or a folder of them); {path} is none")
    inside = path.is_dir() and any(is_depth_file(file) for file in path.iterdir())
    if not given and not inside and not (path.suffix and is_depth_file(path)):
        return None
    if arguments.fov is not None and arguments.intrinsics:
        raise input_error("--fov: does not go with --intrinsics; leave out one of them")
    return DepthInput(
        depth=path,
        scale=arguments.depth_scale,
        inverse=arguments.inverse_depth,
        settings=DepthSettings(smoothing=arguments.smooth_depth, **given_flags(arguments, DepthSettings)),
        **given_flags(arguments, DepthInput),
    )


FIT = Command(
    "fit a multiscale SDF to a point cloud or depth maps",
    """  mplicits fit scan.ply -o runs/scan
  mplicits fit scan.ply -o runs/scan --mesh scan_mesh.ply
  mplicits fit scan.ply -o runs/quick --preset fast
  mplicits fit scan.ply -o runs/scan --resume
  mplicits fit bunny.ply spot.ply sword.ply -o runs --jobs 2
  mplicits fit scan.xyz -o runs/mine --normals estimate --time-budget 120 --steps 2000 1000 1000
  mplicits fit depth.png --intrinsics camera.json --color color.png -o runs/room --mesh room.glb
  mplicits fit depth/ --intrinsics camera.json --color color/ --poses trajectory.log -o runs/room""",
    _arguments,
    _fit,
    "Fit a multiscale SDF to a point cloud, or to depth maps. RUN will hold field.safetensors and run.json. Of several "
    "clouds, each gets a run in RUN, named as the cloud.",
)


# --- what `mplicits info` says, and a fit when it ends ---

Rows = list[tuple[str, str]]


def describe(path: str | Path) -> str:
    """A few lines about a run, a field, a mesh or a cloud."""
    from ..surface.surface import read_described
    from ..training.folder import is_field

    rows = _describe_field(Path(path)) if is_field(path) else _describe_surface(*read_described(path))
    width = max(len(name) for name, _ in rows)
    return "\n".join([str(path), *(f"  {name:<{width}}  {text}".rstrip() for name, text in rows)])


def _describe_field(path: Path) -> Rows:
    from ...neural_fields import load_field
    from ...neural_fields.networks.multiscale import levels_of
    from ..training.folder import RECORD_FILE, find_field, read_record
    from ..training.trainer import parameter_count

    file = find_field(path)
    field, similarity, metadata = load_field(file)
    record = metadata.get("run", {})
    if path.is_dir() and (path / RECORD_FILE).is_file():
        record = read_record(path)
    rows: Rows = [
        (
            "kind",
            f"{type(field).__name__}, {field.num_levels} level{'s' * (field.num_levels > 1)}, in {field.in_dim}-D",
        ),
        ("parameters", f"{parameter_count(field):,} ({file.stat().st_size / 1024:,.0f} KiB on disk)"),
    ]
    if "tiles" in record:
        rows += _describe_tiles(record)
    stages = {stage.get("level"): stage for stage in record.get("stages", [])}
    for index, level in enumerate(() if "tiles" in record else levels_of(field)):
        stage = stages.get(index, {})
        rows.append((f"level {index}", _describe_level(level, stage)))
        judged = stage.get("held_out")
        if judged and stage["silenced"] != judged.get("kept", not stage["silenced"]):
            rows.append(("  held out", judged["verdict"]))
        elif stage.get("silenced"):
            rows.append(("  held out", f"level {index} set to zero: further from the points than the level before it"))
        if index < len(field.deltas):
            delta = float(field.deltas[index])
            rows.append((f"  band {index}", f"δ = {delta:.5g} ({delta * similarity.scale:.5g} input units)"))
    center = ", ".join(f"{number:.9g}" for number in similarity.center)
    rows.append(("input frame", f"center ({center}), 1 unit = {similarity.scale:.9g} input units"))
    return rows + _describe_record(record, path)


def _describe_tiles(record: dict[str, Any]) -> Rows:
    tiles, seams, memory = record["tiles"], record["seams"], record["peak_memory"]
    errors = [tile["rms_at_points"] for tile in tiles]
    apart = f"{seams['typical']:.3g} input units apart (median; at most {seams['gap']:.3g})"
    turned = sum(tile["sign"] < 0 for tile in tiles)
    return [
        ("tiles", f"{len(tiles):,}, {record['parameters']:,} parameters in all"),
        ("  errors", f"rms at the points {min(errors):.3g} to {max(errors):.3g} input units"),
        ("  seams", f"{apart}, blended over {seams['overlap']:.3g}" + f"; {turned} tiles turned" * (turned > 0)),
        ("  memory", "?" if memory is None else f"{memory / 2**20:,.0f} MiB at most for one tile"),
    ]


def _describe_level(level: Any, stage: dict[str, Any]) -> str:
    from ...neural_fields import Siren
    from ..training.trainer import parameter_count

    text = type(level).__name__
    if isinstance(level, Siren):
        text = f"({level.width}, {level.depth}), ω₀ = {level.omega:g}, {parameter_count(level):,} parameters"
    if "training_seconds" in stage:
        text += f"; {stage['steps']:,} steps in {stage['training_seconds']:.1f} s"
    review = stage.get("review", {})
    for name, what in (("dropped_outliers", "outliers dropped"), ("turned_normals", "normals turned round")):
        if review.get(name):
            text += f"; by it {review[name]:,} {what}"
    if "rms_at_points" in stage:
        text += f"; rms at the points {stage['rms_at_points']:.4g} input units"
    return text


def _describe_record(record: dict[str, Any], path: Path) -> Rows:
    from ...datasets import CleaningReport
    from ..training.folder import resumes_with

    if not record:
        return []
    rows: Rows = [("fitted to", str(record.get("cloud", "?")))]
    if record.get("imported"):
        rows.append(("imported", ", ".join(record["imported"])))
    cleaning, environment = record.get("cleaning", {}), record.get("environment", {})
    if record.get("reading"):
        rows.append(("read", record["reading"]))
    if cleaning:
        known = {name: cleaning[name] for name in CleaningReport.__dataclass_fields__ if name in cleaning}
        rows.append(("points", CleaningReport(**known).summary()))
    if signs := record.get("signs"):
        what = "found no inside: normals keep their estimated signs"
        if signs["clear"]:
            what = f"turned {signs['turned_normals']:,} of {cleaning.get('kept', 0):,} normals"
        what += f" (slope along them {signs['slope']:.2f})"
        rows.append(("signs", f"level 0, trained without orientation, {what}"))
    state = "finished" if record.get("finished") else "unfinished"
    if not record.get("finished") and path.is_dir():
        again = resumes_with(path, record)
        state += f": {again}" if again else ", with nothing to resume from: begin again with --force"
    rows.append(("state", state))
    texture = record.get("texture")
    if texture and not texture.get("finished", True):
        rows.append(("texture", f"unfinished: {command_line('texture', path, texture['source'], '--resume')}"))
    if "training_seconds" in record:
        rows.append(("time", f"{record['training_seconds']:.1f} s"))
    if environment:
        versions = ", ".join(f"{name} {version}" for name, version in environment.get("versions", {}).items())
        rows.append(("made with", f"{versions}, Python {environment.get('python', '?')}"))
        rows.append(("on", f"{environment.get('device', '?')}, {environment.get('threads', '?')} threads"))
    if "seed" in record.get("config", {}):
        rows.append(("seed", str(record["config"]["seed"])))
    return rows


def _describe_surface(surface: Mesh, reading: str) -> Rows:
    from ..surface.surface import components, is_closed

    points = surface.used_vertices()
    low, high = points.min(axis=0), points.max(axis=0)
    rows: Rows = []
    if len(surface.faces):
        rows.append(("kind", "mesh"))
        rows.append(("vertices, faces", f"{len(surface.vertices):,}, {len(surface.faces):,}"))
        rows.append(("closed", "yes" if is_closed(surface) else "no: it has open or badly oriented edges"))
        rows.append(("components", f"{components(surface):,}"))
    else:
        rows.append(("kind", "point cloud"))
        rows.append(("points", f"{len(surface.vertices):,}"))
        rows.append(("read", reading))
        rows.append(("normals", "no" if surface.normals is None else "yes"))
    rows.append(("bounds", "  ".join(f"{axis} {a:.9g} … {b:.9g}" for axis, a, b in zip("xyz", low, high, strict=True))))
    rows.append(("diagonal", f"{math.dist(low, high):.6g}"))
    rows.append(("colors", "no" if surface.colors is None else "yes"))
    return rows
