"""The systems that this one is compared with, each as a `Field`, so that every consumer serves them unchanged."""

from .bacon import BaconSDF
from .banf import BandLimited, BanfSDF
from .hash_grid import HashGridSDF
from .idf import IdfSDF
from .neus import NeusSDF

__all__ = ["BaconSDF", "BandLimited", "BanfSDF", "HashGridSDF", "IdfSDF", "NeusSDF"]
