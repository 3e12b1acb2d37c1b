"""The motion that a run has learnt: a velocity beside its field."""

from __future__ import annotations

from pathlib import Path

from ...neural_fields import InputError
from ...neural_fields.spacetime.velocity import VelocitySiren
from .folder import load_state, read_record

VELOCITY_FILE = "velocity.safetensors"


def load_motion(run: str | Path) -> VelocitySiren | None:
    """The velocity of a run of ``evolve --kind deform``, on the CPU; None where the run has none.

    Args:
        run: its directory, or the file of its field there.

    Raises:
        InputError: the file is damaged, or not of this run.
    """
    folder = Path(run) if Path(run).is_dir() else Path(run).parent
    if not (folder / VELOCITY_FILE).is_file():
        return None
    tensors, about = load_state(folder, name=VELOCITY_FILE)
    record = read_record(folder)
    if about.get("generation") != record.get("generation"):
        raise InputError(f"{folder / VELOCITY_FILE}: not of the run in {folder}; evolve it again")
    config = record["config"]
    velocity = VelocitySiren(config["motion_width"], 2, omega=config["motion_omega"])
    try:
        velocity.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{folder / VELOCITY_FILE}: not a motion as run.json describes it; evolve it again") from error
    return velocity.requires_grad_(False)
