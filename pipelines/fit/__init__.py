"""``fit``: from oriented point clouds to a multiscale SDF, level by level (paper Sec. 3.2)."""

from ..training.settings import FitConfig
from ..training.trainer import Interrupted
from .train import Run, fit, prepare

__all__ = ["FitConfig", "Interrupted", "Run", "fit", "prepare"]
