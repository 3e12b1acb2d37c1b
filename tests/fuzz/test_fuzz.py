"""Damaged files are read or refused in one line, whatever the damage; those that once were not stay so."""

import functools
import io
import json
import os
import struct
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from corpus import Specimen, described_anew, specimens
from mplicits.datasets import read_cloud
from mplicits.neural_fields import InputError

pytest.importorskip("resource", reason="limits of memory are those of POSIX")
import hunt as hunting
from hunt import BAD, case, hunt, outcome_of

SEED, ROUNDS = 2026, 30
# Of these folders' files, which take a tenth of a second each, every seventh round.
SLOW, EVERY = ("sparse/", "transforms.json"), 7
FOUND = sorted((Path(__file__).parent / "found").glob("*.json"))


@functools.cache
def known() -> list[Specimen]:
    return specimens()


def test_whole_files_are_read(tmp_path: Path) -> None:
    for number, specimen in enumerate(known()):
        (tmp_path / f"{number}").mkdir()
        outcome = outcome_of(number, specimen, specimen.data, tmp_path / f"{number}")
        assert outcome.kind == "read", outcome


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path) -> None:
    counts: Counter[str] = Counter()
    found = known()
    for number in range(ROUNDS * len(found)):
        specimen, data = case(found, SEED, number)
        if specimen.name.startswith(SLOW) and number // len(found) % EVERY:
            continue
        (tmp_path / f"{number}").mkdir()
        outcome = outcome_of(number, specimen, data, tmp_path / f"{number}")
        assert outcome.kind not in BAD, f"case {SEED}-{outcome.number}, {outcome.specimen}: {outcome.said[-600:]}"
        counts[outcome.kind] += 1
    assert sum(counts.values()) >= 1000
    assert counts["refused"] > sum(counts.values()) / 2, "the damage is too light to mean anything"


@pytest.mark.slow
def test_the_hunt_goes_on_in_a_process_of_its_own() -> None:
    assert [outcome.number for outcome in hunt(SEED, range(60))] == list(range(60))


@pytest.mark.parametrize("file", FOUND, ids=lambda file: file.stem)
def test_files_that_were_found_stay_mended(file: Path, tmp_path: Path) -> None:
    by_name = {specimen.name: specimen for specimen in known()}
    specimen = by_name[json.loads(file.read_text())["name"]]
    outcome = outcome_of(0, specimen, file.with_suffix(".bin").read_bytes(), tmp_path)
    assert outcome.kind not in BAD, outcome.said[-600:]


def test_a_case_is_the_same_every_time() -> None:
    found, again = specimens(), specimens()
    assert [specimen.data for specimen in found] == [specimen.data for specimen in again]
    for number in range(len(found)):
        assert case(found, 3, number)[1] == case(again, 3, number)[1]


class PlantedError(Exception):
    """What a reader of ours must never let through."""


@pytest.mark.parametrize("kind", ["traceback", "vague", "noise", "hang", "memory"])
def test_the_hunt_sees_what_it_looks_for(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(path: Path) -> None:
        match kind:
            case "traceback":
                raise PlantedError
            case "vague":
                raise InputError("something is wrong")
            case "noise":
                os.write(2, b"libfoo: warning")
            case "hang":
                while True:
                    pass
            case _:
                np.ones(2 << 30, np.uint8)

    monkeypatch.setattr(hunting, "SECONDS", 1)
    assert outcome_of(0, Specimen("a.bin", b"x", read), b"x", tmp_path).kind == kind


def _ply(*, count: str = "2", length: bytes = struct.pack("<i", 3), kind: str = "int") -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement face {count}\nproperty list {kind} int vertex_indices\n"
    return head.encode() + b"end_header\n" + length + bytes(12) + struct.pack("<i", -1) + bytes(40)


def _npy(shape: str) -> bytes:
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + bytes(240)


def _npz(shape: str) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        archive.writestr("points.npy", _npy(shape))
    return memory.getvalue()


def _bomb() -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("points.npy", "w") as file:
        file.write(_npy("(15_000_000, 3)")[:128])
        for _ in range(360):
            file.write(bytes(1_000_000))
    return memory.getvalue()


def _las() -> bytes:
    whole = next(specimen for specimen in known() if specimen.name == "cloud.las").data
    return whole[:107] + struct.pack("<I", 2**27) + whole[111:]  # where version 1.2 has the number of points


ASCII = "ply\nformat ascii 1.0\nelement face 2\nproperty list int int vertex_indices\nend_header\n"


@pytest.mark.parametrize(
    ("name", "make", "said"),
    [
        ("list.ply", lambda: _ply(length=struct.pack("<i", 2**31 - 1)), "the file ends before"),
        ("endless.ply", lambda: _ply(count="3"), "the file ends before"),
        ("count.ply", lambda: _ply(count="1" + "0" * 30), "the file ends before"),
        ("infinite.ply", lambda: (ASCII + "inf 1 2\n3 0 1 2\n").encode(), "the file ends before"),
        ("rows.npy", lambda: _npy("(2147483648, 3)"), "damaged"),
        ("more_rows.npy", lambda: _npy("(" + "9" * 30 + ", 3)"), "damaged"),
        ("rows.npz", lambda: _npz("(2147483648, 3)"), "more than the archive holds"),
        ("bomb.npz", _bomb, "claims 0.36 GB"),
        ("points.las", _las, "LAS"),
        ("index.obj", lambda: b"v 0 0 0\n" * 12 + b"f 1 2 " + b"9" * 30, "index.obj"),
        ("far.xyz", lambda: b"1 2 3\n" * 5 + b"1e200 1 2\n" * 20, "5 coincide"),
        ("tiny.xyz", lambda: b"".join(b"%de-310 1e-310 0\n" % i for i in range(20)), "across"),
    ],
)
def test_claims_are_checked_before_they_are_believed(name, make, said, tmp_path) -> None:
    data = make()
    outcome = outcome_of(0, Specimen(name, data, read_cloud), data, tmp_path)
    assert outcome.kind == "refused", outcome.said[-600:]
    assert said in outcome.said


@pytest.mark.parametrize(
    ("name", "value"),
    [("depth", 10**6), ("depth", 10**12), ("width", 10**9), ("omega", 0), ("type", "Vase"), ("in_dim", 10**30)],
)
def test_a_network_is_not_made_of_what_a_head_claims(name: str, value: object, tmp_path: Path) -> None:
    specimen = next(one for one in known() if one.name == "described.safetensors")

    def claimed(described: dict) -> dict:
        described["field"]["levels"][1][name] = value
        return described

    outcome = outcome_of(0, specimen, described_anew(specimen.data, claimed), tmp_path)
    assert outcome.kind == "refused", outcome.said[-600:]
