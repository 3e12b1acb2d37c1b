"""What every training returns: a field, where it belongs, and the record of how it was made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from ...neural_fields import Field, Mesh, Similarity, WorldField, save_field
from ...neural_fields.spacetime.dynamic_tracing import moment

F = TypeVar("F", bound=Field, covariant=True)


@dataclass(frozen=True)
class Run(Generic[F]):
    """A finished training.

    Attributes:
        field: the trained field, in unit-sphere coordinates, on the CPU.
        similarity: the way back to input coordinates.
        directory: where it was written, or None.
        record: what ``run.json`` holds, figures among it.
    """

    field: F
    similarity: Similarity
    directory: Path | None
    record: dict[str, Any]

    def shape(self, time: float | None = None) -> WorldField:
        """The field in input coordinates and units: distances, normals, closest points, rays, meshes.

        Args:
            time: the moment, from 0 to 1, of a surface that moves.
        """
        return WorldField(self.field if time is None else moment(self.field, time), self.similarity)

    @property
    def world(self) -> WorldField:
        """See `shape`."""
        return self.shape()

    def mesh(self, resolution: int = 256, *, time: float | None = None) -> Mesh:
        """A triangle mesh in input coordinates; see `WorldField.mesh`."""
        return self.shape(time).mesh(resolution)

    def save(self, path: str | Path) -> None:
        """Write the field, and where it belongs, to a .safetensors file, whole or not at all.

        Raises:
            InputError: the file cannot be written.
        """
        save_field(path, self.field, similarity=self.similarity, metadata={"run": self.record})

    def show(self, *, up: str = "y", block: bool = True, browser: bool = True) -> Any:
        """Look at the shape, in the browser or in a notebook; see `WorldField.show`."""
        return self.world.show(up=up, block=block, browser=browser)
