"""Matching, checks and motions on few points, for all tests of evolutions."""

import dataclasses

import pytest
from evolutions import few_points
from mplicits.pipelines.evolve import deform


@pytest.fixture(autouse=True)
def _few_points(monkeypatch) -> None:
    few_points(monkeypatch)
    few = dataclasses.replace(deform.MOTION, pool=1000, matched=200, guided=64, loose=64, regular=128, steps=4)
    monkeypatch.setattr(deform, "MOTION", few)
