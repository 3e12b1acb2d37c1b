"""What an interrupted training of a texture leaves beside the texture, so that it can go on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from ..datasets import PointCloud
from ..neural_fields import Field, InputError
from .config import load_config
from .fit_state import digest_of, load_state, save_state
from .texture_config import TextureConfig

__all__ = ["TextureState", "texture_state_file"]


def texture_state_file(texture: Path) -> Path:
    """Where the training of the texture that will be written to ``texture`` is kept."""
    return texture.with_suffix(".resume.safetensors")


@dataclass(frozen=True)
class TextureState:
    """A training under way.

    Attributes:
        config: its settings.
        level: of the geometry; None is the finest.
        fingerprint: of what it learns from; see `fingerprint_of`.
        tensors: network, optimiser and random numbers; see `pack_training`.
    """

    config: TextureConfig
    level: int | None
    fingerprint: str
    tensors: Mapping[str, Tensor]

    @staticmethod
    def fingerprint_of(cloud: PointCloud, geometry: Field) -> str:
        """A digest of points, colours and field, to tell whether a resumed training sees the same."""
        assert cloud.colors is not None
        weights = (tensor.detach().cpu().numpy() for _, tensor in sorted(geometry.state_dict().items()))
        return digest_of((cloud.points, cloud.colors, *weights))

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        about: dict[str, Any] = {"config": dataclasses.asdict(self.config), "level": self.level}
        save_state(path.parent, self.tensors, about | {"fingerprint": self.fingerprint}, name=path.name)

    @staticmethod
    def load(path: Path) -> TextureState:
        """Read what `save` wrote.

        Raises:
            InputError: there is no such file, or it is damaged.
        """
        tensors, about = load_state(path.parent, name=path.name)
        try:
            config = load_config(TextureConfig, None, about["config"])
            return TextureState(config, about["level"], about["fingerprint"], tensors)
        except KeyError as error:
            raise InputError(f"{path}: damaged (no {error}); begin again without --resume") from error
