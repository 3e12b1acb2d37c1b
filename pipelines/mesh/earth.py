"""Where a scene stands: metres with z up around an origin, on the globe if the system of its input is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...neural_fields import InputError
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.fields.similarity import Placement


@dataclass(frozen=True)
class Stand:
    """The coordinates of a scene: metres from an origin, z up.

    Attributes:
        points: input coordinates ``(N, 3)`` → the scene's.
        turn: ``(3, 3)``, by which directions of the input are turned.
        metres: of one input unit.
        transform: ``(4, 4)`` from the scene's coordinates to the globe's, or to those of the input, upright in metres.
        line: what to tell people about it.
    """

    points: Callable[[Float64], Float64]
    turn: Float64
    metres: float
    transform: Float64
    line: str


def upright(placement: Placement, origin: tuple[float, float, float]) -> Stand:
    """A scene whose place on the globe is unknown, around an ``origin`` in input coordinates."""
    into = placement.into(".ply", np.zeros((1, 3)))  # z up and in metres, as far as known
    transform = np.eye(4)
    transform[:3, 3] = into.points(np.asarray(origin))
    line = placement.describe(".ply") or "taken as metres with z up (--unit and --up say otherwise)"
    line += "; not on the globe (--crs names their system, such as EPSG:25832)"
    return Stand(lambda points: into.points(points) - transform[:3, 3], into.turn, into.scale, transform, line)


def on_globe(crs: str, origin: tuple[float, float, float]) -> Stand:
    """A scene in a projected coordinate reference system, x first: axes east, north and up at its ``origin``.

    Every point goes through the system exactly, so the curvature of the globe is in the scene. Heights are as they are:
    those of a system without an ellipsoid of its own count from the ellipsoid WGS 84.

    Raises:
        InputError: pyproj is missing or knows no such system, the system has degrees, or the origin is outside of it.
    """
    try:
        import pyproj
        from pyproj.exceptions import ProjError
    except ImportError as error:
        raise InputError("--crs: places on the globe need pyproj; pip install 'mplicits[las]'") from error
    try:
        system = pyproj.CRS.from_user_input(crs)
        system = system if len(system.axis_info) == 3 else system.to_3d()
        geocentric, geographic = (
            pyproj.Transformer.from_crs(system, f"EPSG:{number}", always_xy=True) for number in (4978, 4979)
        )
    except ProjError as error:
        raise InputError(f"--crs {crs[:80]}: is no coordinate system that pyproj knows; try EPSG:NUMBER") from error

    if not system.is_projected:
        raise InputError(f"--crs {system.name}: has no lengths along its axes; fit a cloud in a projected system")

    def globe(points: Float64) -> Float64:
        return np.stack(geocentric.transform(*np.asarray(points, np.float64).T), axis=-1)

    center = globe(np.asarray(origin))
    longitude, latitude, _ = np.radians(geographic.transform(*origin))
    if not np.isfinite([*center, longitude, latitude]).all():
        raise InputError(f"--crs {system.name}: the middle {origin} is outside of this system; name another, or none")
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    transform = np.eye(4)
    transform[:3, :3] = np.stack((east, np.cross(up, east), up), axis=1)
    transform[:3, 3] = center

    def points(rows: Float64) -> Float64:
        return (globe(rows) - center) @ transform[:3, :3]

    slope = (points(origin + np.eye(3)) - points(origin - np.eye(3))).T / 2  # ∂scene / ∂input, constant over metres
    metres = float(np.cbrt(abs(np.linalg.det(slope))))
    return Stand(
        points, np.linalg.inv(slope).T.astype(np.float64), metres, transform, f"on the globe, by {system.name}"
    )
