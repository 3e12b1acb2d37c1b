"""PCD, the point clouds of PCL, ROS and Open3D: text, binary, and compressed.

Format: "The PCD (Point Cloud Data) file format", pointclouds.org. Compressed bodies hold one field after the other.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ..point_cloud import PointCloud
from .columns import Table, choose_layout, cloud_from
from .tables import numbers

Form = tuple[np.dtype[Any], int]  # of a field: type, and how many numbers


def read_pcd(path: Path, columns: str | None = None) -> PointCloud:
    """The points of a PCD file; colours that are packed into one field ``rgb`` or ``rgba`` are unpacked."""
    data = path.read_bytes()
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[: 1 << 20], re.MULTILINE | re.IGNORECASE)
    if end is None:
        raise InputError(f"{path}: no PCD header with a line DATA; check its extension")
    head = {}
    for words in (line.split() for line in data[: end.start()].decode("utf-8", "replace").splitlines()):
        if words and words[0][0] != "#":
            head[words[0].upper()] = words[1:]
    try:
        names, kinds = head["FIELDS"], head["TYPE"]
        sizes = [int(word) for word in head["SIZE"]]
        counts = [int(word) for word in head.get("COUNT", ["1"] * len(names))]
        width, height = int(head["WIDTH"][0]), int(head.get("HEIGHT", ["1"])[0])
        forms = [np.dtype(f"<{kind.lower()}{size}") for kind, size in zip(kinds, sizes, strict=True)]
        points = int(head.get("POINTS", [str(width * height)])[0])
        if not len(names) == len(forms) == len(counts) or points < 0 or min(counts) < 1:
            raise ValueError(f"{len(names)} fields of {len(forms)} types, {points} points")
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"{path}: damaged PCD header ({error}); export it again") from error
    fields = _fields(data[end.end() :], end[1].decode().lower(), list(zip(forms, counts, strict=True)), points, path)
    table_names: list[str] = []
    values: list[NDArray[Any]] = []
    for name, field in zip(names, fields, strict=True):
        if name.lower() in ("rgb", "rgba") and field.shape[1:] == (1,) and field.dtype.itemsize >= 4:
            whole = field.dtype.kind != "f" or bool((field >= 1).any() and (field % 1 == 0).all())
            packed = field[:, 0].astype(np.int64 if whole else np.float32).view(np.int64 if whole else np.uint32)
            table_names += ["red", "green", "blue"]
            values += [(packed >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)]
        elif field.shape[1] == 1:
            table_names.append(name)
            values.append(field[:, 0])
    table = Table(path, values, table_names)
    return cloud_from(table, choose_layout(table, columns))


def _fields(body: bytes, kind: str, forms: list[Form], points: int, path: Path) -> list[NDArray[Any]]:
    """The fields ``(N, count)`` of all points."""
    size = sum(form.itemsize * count for form, count in forms)
    if kind == "ascii":
        table = numbers(body.decode("utf-8", "replace"), path, first_line=1, what="point")
        ends = np.cumsum([count for _, count in forms])
        if table.shape != (points, ends[-1]):
            raise InputError(f"{path}: {points} points of {ends[-1]} numbers in the header; the body is {table.shape}")
        return [part.astype(form) for part, (form, _) in zip(np.split(table, ends[:-1], axis=1), forms, strict=True)]
    if kind == "binary_compressed" and len(body) >= 8:
        packed, unpacked = struct.unpack_from("<II", body)
        if unpacked > 264 * packed or unpacked < points * size or packed > len(body) - 8:
            raise InputError(f"{path}: claims {unpacked} bytes in {packed} packed ones; export it again")
        body, start, fields = _unpacked(body[8 : 8 + packed], path), 0, []
        for form, count in forms:
            fields.append(np.frombuffer(body, form, points * count, start).reshape(points, count))
            start += points * count * form.itemsize
        return fields
    if kind != "binary" or len(body) < points * size:
        raise InputError(f"{path}: DATA {kind} of {len(body)} bytes; expected {points} points of {size} bytes")
    rows = np.frombuffer(body, np.dtype([(f"{k}", form, (count,)) for k, (form, count) in enumerate(forms)]), points)
    return [rows[f"{k}"] for k in range(len(forms))]


def _unpacked(packed: bytes, path: Path) -> bytes:
    """Unpack LZF: items of 1 to 32 literal bytes, or of 3 to 264 bytes that are copied from at most 8 KiB before."""
    out, at, end = bytearray(), 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        start = len(out) - (control & 31) * 256 - packed[at] - 1
        at, length = at + 1, length + 2
        if start < 0:
            raise InputError(f"{path}: damaged at byte {at} of the packed points; copy or export it again")
        piece = out[start : start + length]
        out += (piece * (length // len(piece) + 1))[:length]  # a copy may overlap what it makes
    return bytes(out)
