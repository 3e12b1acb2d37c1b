"""Packages of npm that tests use: fetched into a folder; tests skip where they are not to be had."""

import shutil
import subprocess
from pathlib import Path

import pytest

THREE = "three@0.180.0"
TILES = "3d-tiles-renderer@0.4.28"
VALIDATOR = "gltf-validator@2.0.0-dev.3.10"
FLAGS = ("--no-save", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline", "--fetch-retries=0")


def fetch(folder: Path, *packages: str) -> None:
    """Install packages into ``folder/node_modules``, or skip the test that wants them."""
    npm, package = shutil.which("npm"), " and ".join(packages)
    if npm is None:
        pytest.skip(f"no npm on this machine to fetch {package} with")
    words = [npm, "install", "--prefix", str(folder), *FLAGS, *packages]
    try:
        fetched = subprocess.run(words, capture_output=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{package} is not to be had from npm: no answer")
    if fetched.returncode:
        pytest.skip(f"{package} is not to be had from npm: {fetched.stderr[-200:].decode(errors='replace')}")
