"""Fields of the systems that this one is compared with; tracer, mesher and renderers take them as any other `Field`."""

from .bacon import BaconSDF
from .banf import BandLimited, BanfSDF
from .hash_grid import HashGridSDF
from .idf import IdfSDF

__all__ = ["BaconSDF", "BandLimited", "BanfSDF", "HashGridSDF", "IdfSDF"]
