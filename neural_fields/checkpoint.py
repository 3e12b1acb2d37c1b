"""Fields on disk: safetensors with a description in the header. No pickle, nothing executed on loading."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from .backend.errors import InputError
from .backend.files import write_whole
from .fields.csg import Bounded, Combined, Difference, Intersection, Offset, Placed, Shell, Union
from .fields.field import Field, plain
from .fields.primitives import Box, Capsule, Plane, Sphere, Torus
from .fields.similarity import Similarity
from .fields.tiled import Split, Tile, TiledField
from .networks.colors import BackgroundField, ColorNetwork, ColorSiren, Radiance, TextureField
from .networks.encoded import EncodedField
from .networks.grids import HashEncoding, grid_resolutions
from .networks.multiscale import MultiscaleSDF
from .networks.neus_mlp import NeusSDF
from .networks.siren import Siren
from .spacetime.field import SpaceTimeSDF

M = TypeVar("M", bound=nn.Module)

# Types by name: built from their definition, combinations also from their parts.
NETWORKS: Mapping[str, Callable[..., Field]] = {cls.__name__: cls for cls in (Siren, NeusSDF)}
CLOSED: Mapping[str, Callable[..., Field]] = {cls.__name__: cls for cls in (Box, Capsule, Plane, Sphere, Torus)}
COMBINED: Mapping[str, Callable[..., Field]] = {
    cls.__name__: cls for cls in (Bounded, Difference, Intersection, Offset, Placed, Shell, Union)
}
FILE_VERSION = 1


class _Kind(NamedTuple):
    """A kind of file."""

    thing: str  # its content
    command: str  # that writes it
    name: str  # its usual name
    remedy: str  # if it is damaged

    @property
    def key(self) -> str:
        """Key of the description in the file's metadata."""
        return f"mplicits-{self.thing.split()[-1]}"


_FIELD = _Kind("a field", "mplicits fit", "field.safetensors", "take it from a backup, or fit again")
_TEXTURE = _Kind("a texture", "mplicits texture", "texture.safetensors", "run `mplicits texture` again")
_RADIANCE = _Kind(
    "a radiance",
    "mplicits reconstruct",
    "radiance.safetensors",
    "take it from a backup, or run `mplicits reconstruct` again",
)
COLOR_SIZES = ("num_features", "width", "depth", "view_frequencies", "point_frequencies")
OUTSIDE_SIZES = ("width", "depth", "point_frequencies", "view_frequencies")


class SavedField(NamedTuple):
    """Content of a checkpoint.

    Attributes:
        field: on the device asked for, in unit-sphere coordinates.
        similarity: from input to unit-sphere coordinates.
        metadata: JSON values of the writer.
    """

    field: Field
    similarity: Similarity
    metadata: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class TileFiles:
    """The tiles of a `TiledField` in files of `save_field`.

    Attributes:
        folder: that of the field's own file.
        names: paths of the tiles from there.
        similarity: from input coordinates to those of all tiles.
        signs: −1 for tiles whose inside is to be outside.
    """

    folder: Path
    names: tuple[str, ...]
    similarity: Similarity
    signs: tuple[int, ...]

    def __call__(self, number: int) -> Tile:
        """Read a tile; errors as of `load_field`."""
        field, own, _ = load_field(self.folder / self.names[number])
        return Tile(field, own.within(self.similarity), self.signs[number])


def save_field(
    path: str | os.PathLike[str],
    field: Field,
    *,
    similarity: Similarity | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Write ``field`` to a safetensors file, whole or not at all.

    Args:
        path: the file; replaced.
        field: a `Siren`, a `MultiscaleSDF` of them, a `SpaceTimeSDF` of that, a closed form such as `Sphere`, a
            combination of these such as `Union`, or a `TiledField` of `TileFiles` in the folder of the file.
        similarity: from input to unit-sphere coordinates; the identity by default.
        metadata: JSON values to keep with the field.

    Raises:
        TypeError: a field of this type cannot be described on disk.
    """
    write_whole(Path(path), field_bytes(field, similarity=similarity, metadata=metadata))


def field_bytes(
    field: Field, *, similarity: Similarity | None = None, metadata: Mapping[str, Any] | None = None
) -> bytes:
    """Content of a file of `save_field`, with the same arguments and errors."""
    similarity = similarity or Similarity.identity()
    header = {
        "field": _describe(field),
        "similarity": {"center": list(similarity.center), "scale": similarity.scale},
        "metadata": dict(metadata or {}),
    }
    return _packed(dict(field.state_dict()), _FIELD, header)


def load_field(path: str | os.PathLike[str], *, device: torch.device | str = "cpu") -> SavedField:
    """Read what `save_field` wrote.

    Raises:
        InputError: there is no such file, it is damaged, or it is not a field of this package.
    """
    path = Path(path)
    with _reading(path, _FIELD, device) as (header, tensors):
        similarity = similarity_of(header["similarity"])
        tiled = header["field"]["type"] == "TiledField"
        field = _tiled(header["field"], path.parent, similarity) if tiled else _build(header["field"], tensors)
        _restore(path, field, tensors, "fit the field again")
        return SavedField(field.to(device).requires_grad_(False), similarity, header["metadata"])


def save_texture(
    path: str | os.PathLike[str], texture: TextureField, *, metadata: Mapping[str, Any] | None = None
) -> None:
    """Write a texture, without its geometry, to a safetensors file, whole or not at all."""
    write_whole(Path(path), texture_bytes(texture, metadata=metadata))


def texture_bytes(texture: TextureField, *, metadata: Mapping[str, Any] | None = None) -> bytes:
    """Content of a file of `save_texture`; a digest of the geometry binds the colours to it."""
    siren = texture.network.siren
    header = {
        "network": {"width": siren.width, "depth": siren.depth, "omega": siren.omega, "in_dim": siren.in_dim},
        "geometry": {"level": texture.geometry_level, "digest": _digest(texture.geometry)},
        "metadata": dict(metadata or {}),
    }
    tensors = {name: tensor for name, tensor in texture.state_dict().items() if not name.startswith("geometry.")}
    return _packed(tensors, _TEXTURE, header)


def load_texture(path: str | os.PathLike[str], geometry: Field) -> TextureField:
    """Read what `save_texture` wrote, around ``geometry``, the field that it was trained on, and on its device.

    Raises:
        InputError: there is no such file, it is damaged, no texture, or one of another geometry.
    """
    path = Path(path)
    device = geometry.like.device
    with _reading(path, _TEXTURE, device) as (header, tensors):
        _check_geometry(path, header, geometry, _TEXTURE)
        sizes = dict(header["network"])
        _check_size(sizes, tensors)
        network = ColorSiren(sizes.pop("width"), sizes.pop("depth"), **sizes)
        prefix = "network."
        own = {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
        _restore(path, network, own, "run `mplicits texture` again")
        texture = TextureField(
            geometry,
            network.to(device).requires_grad_(False),
            delta=float(tensors["delta"]),
            geometry_level=header["geometry"]["level"],
            outside=tensors["outside"].tolist(),
        )
        texture.delta, texture.outside = tensors["delta"], tensors["outside"]  # in the precision they were saved in
        return texture


def save_radiance(
    path: str | os.PathLike[str], radiance: Radiance, geometry: Field, *, metadata: Mapping[str, Any] | None = None
) -> None:
    """Write the radiance of a geometry to a safetensors file, whole or not at all."""
    write_whole(Path(path), radiance_bytes(radiance, geometry, metadata=metadata))


def radiance_bytes(radiance: Radiance, geometry: Field, *, metadata: Mapping[str, Any] | None = None) -> bytes:
    """Content of a file of `save_radiance`; a digest of the geometry binds the colours to it."""
    color, outside = radiance.color, radiance.outside
    header = {
        "color": _radiant_of(color, COLOR_SIZES),
        "outside": None if outside is None else _radiant_of(outside, OUTSIDE_SIZES),
        "inv_std": float(radiance.inv_std),
        "geometry": {"digest": _digest(geometry)},
        "metadata": dict(metadata or {}),
    }
    tensors = {f"color.{name}": tensor for name, tensor in color.state_dict().items()}
    if outside is not None:
        tensors |= {f"outside.{name}": tensor for name, tensor in outside.state_dict().items()}
    return _packed(tensors | {"background": radiance.background}, _RADIANCE, header)


def load_radiance(path: str | os.PathLike[str], geometry: Field) -> tuple[Radiance, dict[str, Any]]:
    """Read what `save_radiance` wrote, and its metadata, onto the device of ``geometry``, which was trained with it.

    Raises:
        InputError: there is no such file, it is damaged, no radiance, or one of another geometry.
    """
    path = Path(path)
    with _reading(path, _RADIANCE, geometry.like.device) as (header, tensors):
        _check_geometry(path, header, geometry, _RADIANCE)
        inv_std = float(header["inv_std"])
        if not 0 < inv_std < math.inf or tensors["background"].shape != (3,):
            raise ValueError(f"inv_std {inv_std:g}, background of shape {tuple(tensors['background'].shape)}")
        color = _radiant(path, ColorNetwork, "color", header, tensors)
        outside = None if header["outside"] is None else _radiant(path, BackgroundField, "outside", header, tensors)
        return Radiance(color, outside, tensors["background"], inv_std), header["metadata"]


def _radiant_of(network: ColorNetwork | BackgroundField, sizes: Sequence[str]) -> dict[str, Any]:
    """Arguments of the network, from which `_radiant` makes it again."""
    grid = None if network.grid is None else _grid_of(network.grid)
    return {name: getattr(network, name) for name in sizes} | {"grid": grid}


def _grid_of(grid: HashEncoding) -> dict[str, Any]:
    """Arguments of the encoding, from which `_made_grid` makes it again."""
    return {
        "levels": len(grid.resolutions),
        "table_size": grid.table_size,
        "features": grid.table.shape[1],
        "coarsest": grid.resolutions[0],
        "finest": grid.resolutions[-1],
        "extent": grid.extent,
    }


def _radiant(
    path: Path, kind: Callable[..., M], name: str, header: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> M:
    """A network of a radiance, from its description and tensors."""
    own = {key.removeprefix(f"{name}."): held for key, held in tensors.items() if key.startswith(f"{name}.")}
    sizes = dict(header[name])
    grid = sizes.pop("grid")
    _check_size(sizes, own)
    network = kind(**sizes, grid=None if grid is None else _made_grid(grid, own))
    _restore(path, network, own, "run `mplicits reconstruct` again")
    return network.to(tensors["background"].device).requires_grad_(False)


def _made_grid(described: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> HashEncoding:
    """An untrained encoding; ValueError if it would have more numbers than the file."""
    _check_size({"levels": described["levels"], "features": described["features"]}, tensors)
    resolutions = grid_resolutions(described["levels"], described["coarsest"], described["finest"])
    entries = sum(min((cells + 1) ** 3, described["table_size"]) for cells in resolutions)
    _check_size({"entries": entries}, tensors)
    return HashEncoding(**described)


def _digest(field: Field) -> str:
    """SHA-256 of a field's tensors in float32, the same on every device and in every precision above it."""
    digest = hashlib.sha256()
    for name, tensor in sorted(field.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().float().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _check_geometry(path: Path, header: Mapping[str, Any], geometry: Field, kind: _Kind) -> None:
    if header["geometry"]["digest"] != _digest(geometry):
        raise InputError(f"{path}: {kind.thing} of another field than this one; run `{kind.command}` again")


def checksum_of(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of tensors on the CPU, with their names, types and shapes."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _packed(state: Mapping[str, Tensor], kind: _Kind, header: Mapping[str, Any]) -> bytes:
    # Cloned: a field that is part of a combination twice has its tensors twice, which safetensors refuses.
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in state.items()}
    described = {"format": kind.key, "version": FILE_VERSION, **header, "checksum": checksum_of(tensors)}
    # Bytes, not save_file: that ignores the umask, so that other users cannot read the file.
    return save(tensors, metadata={kind.key: json.dumps(described)})


@contextmanager
def _reading(path: Path, kind: _Kind, device: torch.device | str) -> Iterator[tuple[dict[str, Any], dict[str, Tensor]]]:
    """Header and tensors of a file; any error in the block becomes an `InputError`."""
    thing, command = kind.thing, kind.command
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected {thing} written by `{command}` ({kind.name})")
    try:
        with safe_open(path, framework="pt") as file:  # it knows few devices by name; torch moves to any
            if (header_text := (file.metadata() or {}).get(kind.key)) is None:
                raise InputError(f"{path}: a safetensors file, but not {thing}; expected one written by `{command}`")
            header = json.loads(header_text)
            if header["version"] != FILE_VERSION:
                raise InputError(
                    f"{path}: {thing.split()[-1]} format version {header['version']}; this mplicits reads version "
                    f"{FILE_VERSION}, so write it again with `{command}` or install the version that wrote it"
                )
            if not isinstance(header["metadata"], dict):
                raise TypeError(f"metadata is a {type(header['metadata']).__name__}")
            held = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if header.get("checksum") not in (None, checksum_of(held)):  # older files have none
                raise InputError(f"{path}: damaged (its numbers are not those that were written); {kind.remedy}")
            tensors = {name: tensor.to(device) for name, tensor in held.items()}
        yield header, tensors
    except InputError:
        raise
    except Exception as error:  # a foreign header may make constructors fail in any way
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: damaged, or not {thing} written by `{command}` ({reason})") from error


def _restore(path: Path, module: nn.Module, tensors: Mapping[str, Tensor], remedy: str) -> None:
    """Load tensors in their own precision, and refuse those that are not finite."""
    for tensor in tensors.values():
        if tensor.is_floating_point():
            module.to(dtype=tensor.dtype)
    module.load_state_dict(tensors)
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{path}: tensor {name!r} has NaN or infinite entries; {remedy}")


def _describe(field: Field) -> dict[str, Any]:
    """The arguments from which `_build` makes an untrained copy."""
    if isinstance(field, MultiscaleSDF):
        return {"type": "MultiscaleSDF", "taper": field.taper, "levels": [_describe(level) for level in field.levels]}
    if isinstance(field, SpaceTimeSDF):
        return {"type": "SpaceTimeSDF", "sdf": _describe(field.sdf)}
    if isinstance(field, EncodedField):
        grid = _grid_of(field.grid)
        return {"type": "EncodedField", "field": _describe(field.field), "grid": grid, "gain": field.gain}
    if isinstance(field, TiledField) and isinstance(field.load, TileFiles):
        about = {"levels": field.num_levels, "tiles": field.load.names, "signs": field.load.signs}
        return {"type": "TiledField", **about, **plain(field.definition())}
    name = "Siren" if isinstance(field, Siren) else type(field).__name__
    if isinstance(field, Siren | NeusSDF) or type(field) is CLOSED.get(name):
        return {"type": name, **plain(field.definition())}
    if isinstance(field, Combined):
        definition = plain(field.definition())
        if isinstance(field, Placed):
            definition["similarity"] = dataclasses.asdict(field.similarity)
        return {"type": name, "parts": [_describe(part) for part in field.fields], **definition}
    raise TypeError(
        f"a {name} cannot be saved; expected a Siren, a MultiscaleSDF of Sirens, a SpaceTimeSDF, one of them encoded, "
        "a closed form, or a combination of these; a mesh of it can be (extract_mesh)"
    )


def _tiled(description: Mapping[str, Any], folder: Path, similarity: Similarity) -> TiledField:
    """A field whose tiles are files in ``folder``; InputError if one is missing."""
    names, signs = tuple(description["tiles"]), tuple(description["signs"])
    splits = [Split(*split) for split in description["splits"]]
    if not len(names) == len(signs) == len(splits) + 1:
        raise ValueError(f"{len(splits)} splits, {len(names)} tiles and {len(signs)} signs")
    for name in names:
        if not (folder / name).is_file():
            raise InputError(f"{folder / name}: no such file; it is a tile of {folder}: bring it back, or fit again")
    deltas = [1.0] * (description["levels"] - 1)  # they are among the tensors
    numbers = {name: description[name] for name in ("reach", "gap", "domain")}
    return TiledField(TileFiles(folder, names, similarity, signs), splits, deltas=deltas, **numbers)


def similarity_of(described: Mapping[str, Any]) -> Similarity:
    """The similarity that a file describes by ``center`` and ``scale``; ValueError if they are no such numbers."""
    x, y, z = (float(number) for number in described["center"])
    scale = float(described["scale"])
    if not (all(map(math.isfinite, (x, y, z))) and 0 < scale < math.inf):
        raise ValueError(f"similarity: center {x:g} {y:g} {z:g}, scale {scale:g}")
    return Similarity((x, y, z), scale)


def _check_size(arguments: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError if a whole number of a description is larger than the file allows."""
    held = sum(tensor.numel() for tensor in tensors.values())
    for name, number in arguments.items():
        most = len(tensors) if name == "depth" else held
        if isinstance(number, int) and number > most:
            raise ValueError(f"{name} {number:.6g} in a file of {held:,} numbers")


def _build(description: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Field:
    arguments = {key: value for key, value in description.items() if key != "type"}
    kind = description["type"]
    if kind in NETWORKS:
        _check_size(arguments, tensors)
        return NETWORKS[kind](**arguments)
    if kind == "MultiscaleSDF":
        levels = [_build(level, tensors) for level in description["levels"]]
        # The band widths are among the tensors; the constructor only needs as many of them.
        return MultiscaleSDF(levels[0], levels[1:], [1.0] * (len(levels) - 1), taper=description["taper"])
    if kind == "SpaceTimeSDF":
        sdf = _build(description["sdf"], tensors)
        if not isinstance(sdf, MultiscaleSDF):
            raise ValueError(f"a SpaceTimeSDF of a {type(sdf).__name__}")
        return SpaceTimeSDF(sdf)
    if kind == "EncodedField":
        grid = _made_grid(arguments["grid"], tensors)
        return EncodedField(_build(arguments["field"], tensors), grid, gain=arguments["gain"])
    if kind in CLOSED:
        return CLOSED[kind](
            **{key: tuple(value) if isinstance(value, list) else value for key, value in arguments.items()}
        )
    if kind in COMBINED:
        if "similarity" in arguments:
            arguments["similarity"] = similarity_of(arguments["similarity"])
        parts = [_build(part, tensors) for part in arguments.pop("parts")]
        return COMBINED[kind](*parts, **arguments)
    raise ValueError(f"unknown field type {kind!r}")
