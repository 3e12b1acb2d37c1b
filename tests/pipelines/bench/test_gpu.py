"""Pictures of a run, counted for GPUs that are not here: the command and its table."""

import os
from pathlib import Path

import pytest
from mplicits.neural_fields import InputError, MultiscaleSDF, Siren, save_field
from mplicits.neural_fields.sphere_start import solve_sphere
from mplicits.pipelines.bench.gpu import GpuBench
from mplicits.pipelines.cli.entry import main


def saved(path: Path, in_dim: int = 3) -> Path:
    base = Siren(16, 1, omega=8.0, in_dim=in_dim)
    if in_dim == 3:
        solve_sphere(base, radius=0.5)
    save_field(path, MultiscaleSDF(base, [Siren(8, 1, output_gain=0.01, in_dim=in_dim)], [0.05]))
    return path


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = saved(tmp_path / "ball.safetensors")
    assert main(["bench", "gpu", str(run), "--sizes", "16x12", "--model", "h100", "m2"]) == 0
    said = capsys.readouterr().out
    assert "16×12, level 0" in said
    assert "16×12, all levels" in said
    assert "A model, not a measurement" in said
    assert main(["bench", "gpu", str(run), "--sizes", "16"]) == 2
    assert "'16': expected WIDTHxHEIGHT" in capsys.readouterr().err


def test_counts_do_not_depend_on_the_machine(tmp_path: Path) -> None:
    bench = GpuBench(run_file=saved(tmp_path / "ball.safetensors"), sizes=((16, 16),))
    first, again = bench.rows(tmp_path / "a"), bench.rows(tmp_path / "b")
    assert [row.counts for row in first] == [row.counts for row in again]
    coarse, fine = (row.counts for row in first)
    assert coarse.calls == fine.calls == 5  # three sizes of cones, the march, and the jets of what is seen
    assert fine.products > coarse.products > 0
    assert fine.rest_waits == coarse.rest_waits  # rays that begin, and pixels that see something
    assert fine.chain > coarse.chain


def test_space_time_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a field of 4 dimensions"):
        GpuBench(run_file=saved(tmp_path / "moving.safetensors", in_dim=4)).cells()


def test_pictures_are_timed_where_it_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLICITS_KERNELS", "off")
    run = saved(tmp_path / "ball.safetensors")
    assert main(["bench", "gpu", str(run), "--sizes", "16x16", "--timed", "cpu"]) == 0
    said = capsys.readouterr().out
    assert "Pictures that were timed" in said
    assert "Pictures a second on cpu" in said
    rows = GpuBench(run_file=run, sizes=((16, 16),), timed="cpu").rows(tmp_path / "kept")
    assert all([*row.rates] == ["PyTorch"] for row in rows)  # kernels are for CUDA
    assert all(0 < row.rates["PyTorch"] < 1e5 for row in rows)
    assert os.environ["MPLICITS_KERNELS"] == "off"
    assert main(["bench", "gpu", str(run), "--timed", "abacus"]) == 2
    assert "--timed abacus: not usable here" in capsys.readouterr().err
