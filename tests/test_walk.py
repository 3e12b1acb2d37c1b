"""The walks of docs/architecture.md: what is entered, and what counts as a climb."""

from mplicits.pipelines.surface import read_surface
from mplicits.pipelines.training.jobs import run_jobs
from test_layout import ROOT
from walk import WALKS, report, top_room, walk


def test_a_point_goes_one_way() -> None:
    stays = WALKS["jet"]()
    assert stays[0].caller is None
    assert stays[0].file == ROOT / "neural_fields/networks/multiscale.py"
    assert {top_room(stay.file) for stay in stays} == {"neural_fields"}
    assert not any(stay.climbs for stay in stays)


def test_what_a_lower_room_calls_in_a_higher_one_is_a_climb() -> None:
    stays = walk(lambda: run_jobs(read_surface, ["absent.ply"]))
    (climb,) = [stay for stay in stays if stay.climbs]
    assert climb.caller == ROOT / "pipelines/training/jobs.py"
    assert climb.file == ROOT / "pipelines/surface/surface.py"
    assert "climb: pipelines/training/jobs.py → pipelines/surface/surface.py" in report("jobs", stays)
