"""The systems that this one is compared with, each as a `Field`, so that every consumer serves them unchanged."""

from .bacon import BaconSDF
from .idf import IdfSDF
from .neus import NeusSDF

__all__ = ["BaconSDF", "IdfSDF", "NeusSDF"]
