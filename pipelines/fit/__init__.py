"""``fit``: from oriented point clouds to a multiscale SDF, level by level (paper Sec. 3.2)."""

from ..run.settings import FitConfig
from ..run.trainer import Interrupted
from .train import Run, fit, prepare

__all__ = ["FitConfig", "Interrupted", "Run", "fit", "prepare"]
