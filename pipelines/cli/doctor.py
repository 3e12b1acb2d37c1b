"""``mplicits doctor``: is everything here that a fit needs, and how fast is this machine?"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
from dataclasses import dataclass
from typing import Literal

import torch

from ...neural_fields import InputError
from ...neural_fields.backend.devices import sgemm_rate
from ...neural_fields.backend.kernels.switch import choose

PACKAGE = "mplicits"
OWN_CV2 = "opencv-contrib-python-headless"
OTHER_CV2 = ("opencv-python", "opencv-python-headless", "opencv-contrib-python")


@dataclass(frozen=True)
class Finding:
    """One line of the report: a topic, and what was found there and what to do.

    ``level`` is "ok", "note" (works without), "warning" (works badly) or "error" (does not work).
    """

    level: Literal["ok", "note", "warning", "error"]
    topic: str
    text: str


def examine() -> list[Finding]:
    """Check Python, packages, threads, GPU and speed."""
    # Not what developers need, nor the versions that a host has pinned, which `_cv2` judges.
    asked = [
        line for line in importlib.metadata.requires(PACKAGE) or [] if not re.search("extra == .dev|^[^;]*==", line)
    ]
    return [
        Finding("ok", "Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
        *(_requirement(line) for line in asked),
        _cv2(),
        _threads(),
        _cuda(),
        _kernels(),
        _speed(),
    ]


def format_findings(findings: list[Finding]) -> str:
    """The report, and a verdict as its last line."""
    width = max(len(finding.topic) for finding in findings)
    lines = [f"{finding.level:<7}  {finding.topic:<{width}}  {finding.text}" for finding in findings]
    errors, warnings = (sum(finding.level == level for finding in findings) for level in ("error", "warning"))
    verdict = f"{errors} errors: see above" if errors else "all that is needed is here"
    return "\n".join([*lines, verdict + f"; {warnings} warnings" * bool(warnings)])


def _installed(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _requirement(requirement: str) -> Finding:
    """The installed version of a requirement such as ``name[extras]>=1.2; extra == "plot"``; extras are optional."""
    match = re.match(r"([A-Za-z0-9._-]+)(?:\[[^\]]*\])?(?:>=([0-9.]+))?", requirement)
    assert match is not None, requirement
    name, lowest = match[1], match[2] or "0"
    extra = re.search(r"""extra == ["']([\w-]+)["']""", requirement)
    version = _installed(name)
    usable = version is not None and _numbers(version) >= _numbers(lowest)
    if extra is not None:
        if usable:
            return Finding("ok", name, f"{version} (optional: {extra[1]})")
        return Finding("note", name, f"optional, not installed; pip install '{PACKAGE}[{extra[1]}]'")
    if usable:
        return Finding("ok", name, version or "")
    what = "not installed" if version is None else f"{version} is too old"
    return Finding("error", name, f"{what}; pip install '{name}>={lowest}'")


def _numbers(version: str) -> tuple[int, ...]:
    """``"2.13.0+cpu"`` → (2, 13, 0)."""
    return tuple(int(part) for part in re.match(r"[0-9.]*", version)[0].split(".") if part)  # pyright: ignore[reportOptionalSubscript]


def _cv2() -> Finding:
    others = [name for name in OTHER_CV2 if _installed(name)]
    if others and len({_installed(name) for name in (*others, OWN_CV2)}) == 1:
        return Finding("ok", "cv2", f"{len(others) + 1} wheels of one version")
    if others:
        names = " ".join(others)
        fix = f"pip uninstall {names} {OWN_CV2}, then pip install {OWN_CV2}"
        return Finding("warning", "cv2", f"{names} and {OWN_CV2} overwrite each other's files; {fix}")
    return Finding("ok", "cv2", "one wheel only")


def _threads() -> Finding:
    threads, cores = torch.get_num_threads(), os.cpu_count() or 1
    text = f"{threads} of {cores} logical CPUs"
    if threads < cores // 2:
        return Finding("warning", "threads", f"{text}; unset OMP_NUM_THREADS to use more")
    how = "each with blocks of points of its own" if threads > 1 else "blocks of points one after the other"
    return Finding("ok", "threads", f"{text}; {how}")


def _cuda() -> Finding:
    if not torch.cuda.is_available():
        return Finding("note", "CUDA", "none; fits run on the CPU")
    try:
        torch.ones(8, device="cuda").sum().item()
    except RuntimeError as error:
        return Finding("warning", "CUDA", f"present but unusable ({str(error).splitlines()[0]}); use --device cpu")
    memory = torch.cuda.get_device_properties(0).total_memory / 2**30
    return Finding("ok", "CUDA", f"{torch.cuda.get_device_name(0)}, {memory:.0f} GiB")


def _kernels() -> Finding:
    """Who evaluates networks, and why not by fused kernels; asked as a field asks."""
    x = torch.empty(0, 3, device="cuda" if torch.cuda.is_available() else "cpu")
    try:
        choice = choose(x, width=128, depth=2)
    except InputError as error:
        return Finding("warning", "kernels", str(error))
    if choice.reason:
        return Finding("note", "kernels", f"PyTorch evaluates all networks ({choice.reason})")
    how = "fused kernels; values, jets, rays and pictures by products of float16 halves, with float32's error; "
    how += "training's jets in IEEE float32"
    return Finding("ok", "kernels", f"{how}; PyTorch for features, float64 and second derivatives")


def _speed() -> Finding:
    rate = sgemm_rate(256, repeats=100) / 1e9
    text = f"{rate:.0f} GFLOP/s in float32 matrix products of 2048 × 256 × 256"
    if rate < 15:  # the two minutes of the default preset become more than ten
        return Finding("warning", "speed", f"{text}: slow, so start with --preset fast; is the machine busy?")
    return Finding("ok", "speed", text)
