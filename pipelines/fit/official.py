"""Models of the paper's own code (``dsilvavinicius/m-plicits``): SIREN state dicts, read as levels and written again.

Their networks compute sin(ω₀ (W x + b)) in every layer but the last. Most files have ω₀ folded into W and b, so that
it is 1 outside of them.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...datasets import read_cloud
from ...neural_fields import InputError, MultiscaleSDF, Similarity, Siren, load_field
from ...neural_fields.backend.files import damage, json_bytes, write_whole
from ...neural_fields.checkpoint import similarity_of
from ...neural_fields.networks.encoded import EncodedField
from ...neural_fields.networks.multiscale import levels_of
from ..surface.surface import thinned
from ..training.folder import STAGES, SUPPORT_FILE, WEIGHTS_FILE, RunFolder, find_field, named_cloud
from ..training.result import Run
from ..training.settings import FitConfig
from ..training.trainer import parameter_count
from .samples import delta_of

FRAME_FILE = "frame.json"  # what their format has no place for: bands, taper, input coordinates
FIXED_BAND = 0.1  # half-width of their fixed coarse band (`reconstruct.py`), in units of the sphere: the widest


class _Frame(NamedTuple):
    """What `FRAME_FILE` holds; the values of a model without one."""

    deltas: Sequence[float] | None = None
    taper: float = 0.0
    similarity: Similarity = Similarity.identity()


class Official(NamedTuple):
    """A model that was read.

    Attributes:
        files: of the levels, coarse to fine.
        field: its levels, in unit-sphere coordinates.
        similarity: from input coordinates; the identity unless the folder has one.
        points: of the cloud that gave the bands, ``(N, 3)`` in those coordinates; None without one.
        inside_out: whether level 0 is negative at most corners of the cube [−1, 1]³.
    """

    files: Sequence[Path]
    field: MultiscaleSDF
    similarity: Similarity
    points: Tensor | None
    inside_out: bool


def read_siren(path: str | Path, *, w0: float = 1.0) -> Siren:
    """The SIREN in a state dict that ``torch.save`` wrote.

    Weights and biases come in the order of the file, whatever their names: ``net.0.0.weight`` of the paper's code,
    ``net.0.linear.weight`` of Sitzmann et al., or ``lin0.weight``. A dict may hold the state dict beside other things,
    as ``model_state_dict``. Layers of different widths are filled up with neurons that are always zero. Only tensors
    are read; no code runs. ``w0`` is the frequency ω₀ outside of the weights.

    Raises:
        InputError: there is no such file, or it holds anything else.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a state dict of a SIREN, written by torch.save")
    with damage(path, "expected a state dict of a SIREN, written by torch.save"):
        state = _state_in(path, torch.load(path, map_location="cpu", weights_only=True))
    layers = list(_layers_in(path, state))
    *hidden, (output, _) = layers
    if not hidden or hidden[0][0].shape[1] != 3 or len(output) != 1:
        found = f"{layers[0][0].shape[1]} inputs, {len(hidden)} sine layers and {len(output)} outputs"
        raise InputError(f"{path}: has {found}; expected a signed distance in 3-D: 3 inputs, 1 output, sine layers")
    siren = Siren(max(len(bias) for _, bias in hidden), len(hidden), omega=w0)
    for parameter in siren.parameters():
        parameter.requires_grad_(False).zero_()
    for own, given in zip(siren.raw(), (tensor for layer in layers for tensor in layer), strict=True):
        own[tuple(slice(size) for size in given.shape)] = given
    return siren


def _state_in(path: Path, held: Any) -> Mapping[str, Tensor]:
    """The one state dict in what a file holds."""
    if not isinstance(held, Mapping):
        raise InputError(f"{path}: holds a {type(held).__name__}; expected a state dict of a SIREN")
    if any(isinstance(value, Tensor) for value in held.values()):
        return held
    inner = {
        name: value
        for name, value in held.items()
        if isinstance(value, Mapping) and value and all(isinstance(part, Tensor) for part in value.values())
    }
    if len(inner) != 1:
        raise InputError(f"{path}: holds {len(inner)} state dicts ({', '.join(map(str, held))[:80]}); expected one")
    return next(iter(inner.values()))


def _layers_in(path: Path, state: Mapping[str, Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
    """Weight and bias of each layer; InputError unless they follow on each other."""
    names, width = list(state), None
    for weight, bias in zip(names[::2], [*names[1::2], ""], strict=False):
        if not weight.endswith("weight") or bias != f"{weight.removesuffix('weight')}bias":
            where = f"{weight!r} is followed by {bias!r}" if bias else f"{weight!r} is the last"
            raise InputError(f"{path}: {where}; expected the weight and the bias of each layer, and nothing else")
        matrix, vector = state[weight], state[bias]
        fits = matrix.ndim == 2 and vector.shape == matrix.shape[:1] and width in (None, matrix.shape[-1])
        if not (fits and matrix.is_floating_point() and vector.is_floating_point()):
            shapes = f"{tuple(matrix.shape)} and {tuple(vector.shape)}"
            before = "" if width is None else f" after a layer of {width}"
            raise InputError(f"{path}: {weight!r} and its bias have shapes {shapes}{before}; expected a plain SIREN")
        if not bool(matrix.isfinite().all() and vector.isfinite().all()):
            raise InputError(f"{path}: {weight!r} or its bias has NaN or infinite entries; take it from a backup")
        width = len(matrix)
        yield matrix.float(), vector.float()
    if width is None:
        raise InputError(f"{path}: holds no tensors; expected a state dict of a SIREN")


@torch.no_grad()
def read_official(
    paths: str | Path | Sequence[str | Path],
    *,
    w0: float = 1.0,
    cloud: str | Path | None = None,
    deltas: Sequence[float] | None = None,
    negate: bool = False,
) -> Official:
    """Levels of the paper's code as one field.

    Args:
        paths: a folder with ``coarse/best.pth`` and, for more levels, ``medium`` and ``fine``; or the files, coarse to
            fine.
        w0: see `read_siren`.
        cloud: what the model was trained on, in its coordinates; δ_j = (1 + ε) max |f_j(x)| over its points (Eq. 5).
        deltas: half-widths of the bands instead; their ``reconstruct.py`` takes 0.1 and 0.06.
        negate: change the sign of all levels, for code whose distances are positive inside.

    Raises:
        InputError: a file cannot be read, the bands are not known, or the cloud is not on the coarse surface.
    """
    files, frame = _files_of(paths)
    levels = [read_siren(file, w0=w0) for file in files]
    if negate:
        for tensor in (part for level in levels for part in level.output.parameters()):
            tensor.neg_()
    points = None
    if cloud is not None:
        points = torch.from_numpy(frame.similarity.to_unit(read_cloud(cloud).points)).float()
    widths = frame.deltas if deltas is None and cloud is None else deltas
    if widths is not None and (len(widths) != len(levels) - 1 or not all(0 < width < math.inf for width in widths)):
        raise InputError(f"--deltas {' '.join(map(str, widths))}: expected {len(levels) - 1}, each > 0; one per band")
    if widths is None and points is None and len(levels) > 1:
        fixed = " ".join(("0.1", "0.06")[: len(levels) - 1])
        fix = f"--cloud FILE, the points it was trained on, or --deltas {fixed}, the fixed widths of the paper's code"
        raise InputError(f"{files[0]}: the widths of its bands are not in the files; give {fix}")
    field = MultiscaleSDF(levels[0], [], [])
    if points is not None:
        median = float(field.value(points).abs().median())
        if not median < FIXED_BAND:  # points of another frame or another shape, or another ω₀
            raise InputError(
                f"{cloud}: half of its points lie more than {median:.2g} from the coarse surface; give the cloud in "
                "the model's own coordinates (data/normalized_sphere/input), and as --w0 the frequency of its code"
            )
    for index, level in enumerate(levels[1:]):
        if widths is None:
            assert points is not None
            delta = delta_of(field.value(points), epsilon=FitConfig().epsilon, quantile=1.0)
        else:
            delta = widths[index]
        field = field.with_level(level, delta=delta)
    field.taper = frame.taper
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    return Official(files, field, frame.similarity, points, bool(levels[0].value(corners).median() < 0))


def _files_of(paths: str | Path | Sequence[str | Path]) -> tuple[list[Path], _Frame]:
    """The files of the levels, coarse to fine, and what our export wrote beside them."""
    given = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    if len(given) != 1 or not given[0].is_dir():
        return given, _Frame()
    (folder,) = given
    files = [folder / stage / WEIGHTS_FILE for stage in STAGES]
    there = [file for file in files if file.is_file()]
    if there != files[: len(there)] or not there:
        missing = next(file for file in files if file not in there)
        raise InputError(f"{missing}: no such file; a model has {WEIGHTS_FILE} in coarse/, then medium/, then fine/")
    frame = folder / FRAME_FILE
    if not frame.is_file():
        return there, _Frame()
    with damage(frame, "remove it, and give --deltas"):
        held = json.loads(frame.read_text(encoding="utf-8"))
        taper = float(held["taper"])
        if not 0 <= taper <= 1:
            raise ValueError(f"taper {taper:g}")
        return there, _Frame([float(width) for width in held["deltas"]], taper, similarity_of(held))


def import_official(
    paths: str | Path | Sequence[str | Path], out: str | Path | None = None, **options: Any
) -> Run[MultiscaleSDF]:
    """`read_official`, with its ``options``, into a run directory that all commands take; None writes nothing."""
    files, field, similarity, points, inside_out = read_official(paths, **options)
    folder, cloud, stages = RunFolder(out), {}, []
    with folder.writing():
        if points is not None:
            folder.keep_tensors(SUPPORT_FILE, thinned(points.numpy()))
            cloud = named_cloud(str(options["cloud"]), folder.path)
            with torch.no_grad():
                values = field.level_values(points)
            for index, (level, errors) in enumerate(zip(field.levels, values, strict=True)):
                stage = {"level": index, "parameters": parameter_count(level), "silenced": False}
                stages.append(stage | {"rms_at_points": float(errors.square().mean().sqrt()) * similarity.scale})
        record = {
            **cloud,
            "imported": [str(file) for file in files],
            "inside_out": inside_out,
            "finished": True,
            "similarity": dataclasses.asdict(similarity),
            "config": {name: str(value) if name == "cloud" else value for name, value in options.items()},
            "stages": stages,
            "parameters": parameter_count(field),
            "deltas": field.deltas.tolist(),
        }
        return Run(field, similarity, folder.out, folder.finish(field, similarity, record))


def export_official(run: str | Path, out: str | Path, *, up: str = "y") -> tuple[Path, str]:
    """Write the levels of a run as the paper's code and its renderer read them.

    The folder gets ``coarse/best.pth`` and so on, ω₀ folded in, and the renderer's weights and biases as flat float32.
    By a JSON file with the bands and the input coordinates, `read_official` gives the field back, bit for bit.

    Args:
        run: run directory or .safetensors file.
        out: the folder; files of these names are replaced.
        up: the axis that points up, "y" or "z", for the renderer's first view.

    Returns:
        The renderer's ``.exp`` file, and the flags with which it traces all levels, in the steps of the paper.

    Raises:
        InputError: there is no such run, or their format cannot hold its field.
    """
    file, out = find_field(run), Path(out)
    field, similarity, _ = load_field(file)
    if isinstance(field, EncodedField):  # whose distances are those of the field in it
        field = field.field
    levels = [level for level in levels_of(field) if isinstance(level, Siren) and level.in_dim == 3]
    if len(levels) != field.num_levels or len(levels) > len(STAGES):
        what = f"a {type(field).__name__} of {field.num_levels} levels in {field.in_dim}-D"
        raise InputError(f"{file}: {what}; the paper's format holds up to three plain SIRENs of a shape that is still")
    lines = [f"# {file}"]
    for index, stage in enumerate(STAGES):
        level = levels[min(index, len(levels) - 1)]  # their renderer wants three, and repeats the last one
        weights = [part.detach().float().contiguous() for part in level.folded()]
        weights[-2:] = weights[-2][:1], weights[-1][:1]  # their format has no features
        stem = f"{out.name}_{STAGES[min(index, len(levels) - 1)]}"
        if index < len(levels):
            keys = [f"net.{layer}.0.{name}" for layer in range(level.depth + 1) for name in ("weight", "bias")]
            packed = io.BytesIO()
            torch.save(dict(zip(keys, (part.clone() for part in weights), strict=True)), packed)
            write_whole(out / stage / WEIGHTS_FILE, packed.getvalue())
            for name, parts in (("weights", weights[::2]), ("biases", weights[1::2])):
                flat = torch.cat([part.reshape(-1) for part in parts]).numpy()
                write_whole(out / f"{stem}_{name}.bin", flat.astype("<f4").tobytes())
        lines += [f"lod{index}_layers = {level.depth - 1}", f"lod{index}_hidden = {level.width}"]
        lines += [f"lod{index}_{name} = data/{out.name}/{stem}_{name}.bin" for name in ("weights", "biases")]
    lines += ["textures_layers = 0", "is3d = 1", "surface_w0 = 1", "textures_w0 = 0"]
    lines += [f"swap_y_and_z = {int(up == 'z')}", "invert_z = 0", "flip_y = 1"]  # as for their y-up and z-up shapes
    taper = field.taper if isinstance(field, MultiscaleSDF) else 0.0
    about = {"deltas": field.deltas.tolist(), "taper": taper, **dataclasses.asdict(similarity)}
    write_whole(out / FRAME_FILE, json_bytes(about))
    write_whole(out / f"{out.name}.exp", "\n".join(lines) + "\n")
    steps = ["20", *["5"] * (len(levels) - 1), "0", "0"][: len(STAGES)]
    delta = f" -delta={float(field.deltas[0]):.4g}" if len(levels) > 1 else ""
    return out / f"{out.name}.exp", f"-iters={','.join(steps)}{delta} -normal_lod={len(levels) - 1}"
