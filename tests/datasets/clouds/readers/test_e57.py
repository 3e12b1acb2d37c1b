"""E57 as scanners write it: fields of any kind, poses, scans without points, and damaged files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mplicits.datasets import read_cloud
from mplicits.datasets.clouds.point_cloud import unit_rows
from refusals import refused
from scipy.spatial.transform import Rotation

pye57 = pytest.importorskip("pye57")
libe57 = pye57.libe57

COUNT = 40
RANDOM = np.random.default_rng(0)
P = RANDOM.normal(size=(COUNT, 3)).round(3)
N = unit_rows(RANDOM.normal(size=(COUNT, 3)))
C = RANDOM.random((COUNT, 3))
SOME = (np.arange(COUNT) % 4).astype(np.uint16)
TURN, SHIFT = Rotation.from_euler("xyz", (0.3, -0.5, 1.0)), np.array([4e5, 5e6, 100.0])
POSE = dict(zip("xyzw", TURN.as_quat(), strict=True)), dict(zip("xyz", SHIFT, strict=True))
RANGE = np.linalg.norm(P, axis=1)

Fields = dict[str, np.ndarray]


def fields(prefix: str, names: tuple[str, ...] | str, columns: np.ndarray) -> Fields:
    return {f"{prefix}{name}": column for name, column in zip(names, columns.T, strict=True)}


def xyz(points: np.ndarray = P) -> Fields:
    return fields("cartesian", "XYZ", points)


def rgb(numbers: np.ndarray) -> Fields:
    return fields("color", ("Red", "Green", "Blue"), numbers)


def bits(number: int) -> tuple[Fields, int]:
    return rgb(np.rint(C * (2**number - 1)).astype(np.uint16)), 2**number - 1


SPHERE = fields(
    "spherical",
    ("Range", "Azimuth", "Elevation"),
    np.stack((RANGE, np.arctan2(P[:, 1], P[:, 0]), np.arcsin(P[:, 2] / RANGE)), axis=1),
)


def write_e57(path: Path, *scans: tuple[Fields, dict[str, Any]]) -> Path:
    """Scans of fields, each with ``pose`` (rotation and translation by name) and ``most``, the limit of its colours."""
    image = libe57.ImageFile(str(path), "w")
    for prefix, uri in (("", libe57.E57_V1_0_URI), ("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt")):
        image.extensionsAdd(prefix, uri)
    listed = libe57.VectorNode(image, True)
    image.root().set("data3D", listed)

    def structure(numbers: dict[str, float]) -> Any:
        node = libe57.StructureNode(image)
        for name, number in numbers.items():
            node.set(name, libe57.FloatNode(image, number))
        return node

    for columns, about in scans:
        scan, count = libe57.StructureNode(image), len(next(iter(columns.values())))
        if "pose" in about:
            pose = libe57.StructureNode(image)
            for name, numbers in zip(("rotation", "translation"), about["pose"], strict=True):
                pose.set(name, structure(numbers))
            scan.set("pose", pose)
        if "most" in about:
            ends = {"Minimum": 0.0, "Maximum": float(about["most"])}
            limits = {f"{name}{end}": number for name in rgb(C) for end, number in ends.items()}
            scan.set("colorLimits", structure(limits))
        kept = {name: np.ascontiguousarray(column) for name, column in columns.items()}  # the buffers only point there
        prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        for name, column in kept.items():
            whole = column.dtype.kind == "u"
            prototype.set(name, libe57.IntegerNode(image, 0, 0, 65535) if whole else libe57.FloatNode(image, 0.0))
            buffers.append(libe57.SourceDestBuffer(image, name, column, count, True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("points", points)
        listed.append(scan)
        if count:
            writer = points.writer(buffers)
            writer.write(count)
            writer.close()
    image.close()
    return path


# scans; the points that are read, and the colours and normals if there are any
VARIANTS = {
    "positions": ([(xyz(), {})], P, None, None),
    "pose": ([(xyz(), {"pose": POSE})], TURN.apply(P) + SHIFT, None, None),
    "translation": ([(xyz(), {"pose": ({"w": 1, "x": 0, "y": 0, "z": 0}, POSE[1])})], P + SHIFT, None, None),
    "two scans": ([(xyz(), {"pose": POSE}), (xyz(P + 5), {})], [*(TURN.apply(P) + SHIFT), *(P + 5)], None, None),
    "spherical": ([(SPHERE, {"pose": POSE})], TURN.apply(P) + SHIFT, None, None),
    "spherical and cartesian": ([(SPHERE, {}), (xyz(P + 5), {})], [*P, *(P + 5)], None, None),
    "invalid": ([(xyz() | {"cartesianInvalidState": SOME % 3}, {})], P[SOME % 3 == 0], None, None),
    "spherical, invalid": ([(SPHERE | {"sphericalInvalidState": SOME % 3}, {})], P[SOME % 3 == 0], None, None),
    "an empty scan": ([(xyz(P[:0]), {}), (xyz(), {})], P, None, None),
    "other fields": ([(xyz() | {"intensity": RANGE, "rowIndex": SOME, "isColorInvalid": SOME % 2}, {})], P, None, None),
    "8 bits": ([(xyz() | bits(8)[0], {"most": 255})], P, C, None),
    "10 bits": ([(xyz() | bits(10)[0], {"most": 1023})], P, C, None),
    "16 bits": ([(xyz() | bits(16)[0], {"most": 65535})], P, C, None),
    "16 bits, dark": ([(xyz() | rgb((C * 200).astype(np.uint16)), {"most": 65535})], P, C * 200 / 65535, None),
    "16 bits without limits": ([(xyz() | bits(16)[0], {})], P, C, None),
    "16 bits above their limits": ([(xyz() | bits(16)[0], {"most": 255})], P, C, None),
    "limits of the data": ([(xyz() | bits(8)[0], {"most": 201})], P, C, None),
    "fractions": ([(xyz() | rgb(C), {"most": 1})], P, C, None),
    "scans of 8 and 16 bits": (
        [(xyz() | bits(8)[0], {"most": 255}), (xyz() | bits(16)[0], {"most": 65535})], [*P, *P], [*C, *C], None
    ),
    "normals": ([(xyz() | fields("nor:normal", "XYZ", N), {"pose": POSE})], TURN.apply(P) + SHIFT, None, TURN.apply(N)),
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants(tmp_path: Path, variant: str) -> None:
    scans, points, colors, normals = VARIANTS[variant]
    read = read_cloud(write_e57(tmp_path / "a.e57", *scans))
    np.testing.assert_allclose(read.points, points, rtol=0, atol=1e-8)
    for found, expected in ((read.colors, colors), (read.normals, normals)):
        assert (found is None) == (expected is None)
        if found is not None:
            np.testing.assert_allclose(found, expected, atol=0.5 / 255 + 1e-6)  # half a step of 8 bits
    if "invalid" in variant:
        assert f"{int((SOME % 3 > 0).sum())} invalid points" in read.reading
    if variant == "other fields":
        assert all(name in read.reading for name in ("intensity", "rowIndex"))


def test_colors_of_one_scan_only_are_said_to_be_ignored(tmp_path: Path) -> None:
    read = read_cloud(write_e57(tmp_path / "a.e57", (xyz() | bits(8)[0], {"most": 255}), (xyz(P + 5), {})))
    assert read.colors is None
    assert "colorRed" in read.reading


def test_what_is_written_by_pye57(tmp_path: Path) -> None:
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    w_first = np.roll(TURN.as_quat(), 1)
    file.write_scan_raw(xyz() | rgb((C * 255).astype(np.uint8)), rotation=w_first, translation=SHIFT)
    file.close()
    read = read_cloud(tmp_path / "a.e57")
    np.testing.assert_allclose(read.points, TURN.apply(P) + SHIFT, rtol=0, atol=1e-6)  # it writes float32
    assert np.array_equal(np.rint(read.colors * 255), (C * 255).astype(np.uint8))


def test_without_scans_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    for scans in ([], [(xyz(P[:0]), {})], [({"intensity": RANGE}, {})]):
        with refused(write_e57(path, *scans), "export it again"):
            read_cloud(path)
    whole = write_e57(path, (xyz(), {})).read_bytes()
    for cut in (10, 48, 200, len(whole) // 2, len(whole) - 1024, len(whole) - 3):
        path.write_bytes(whole[:cut])
        with refused(path, "E57"):
            read_cloud(path)
    for at in (60, 1020, len(whole) // 2, len(whole) - 4):  # each page has a checksum
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :])
        with refused(path, "E57"):
            read_cloud(path)
