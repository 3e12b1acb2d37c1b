"""Typed settings: what a YAML file and flags may say, and what each mistake is answered with."""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.training import settings as config
from mplicits.pipelines.training.settings import load_config, setting


@dataclass(frozen=True)
class Settings(config.Settings):
    widths: tuple[int, ...] = setting((128, 256), "width of each level", above=0, per_level=True)
    rates: tuple[float, ...] = setting((1e-3, 1e-4), "rate of each level", at_most=1, above=0, per_level=True)
    normals: Literal["auto", "file"] = setting("auto", "where from")
    origin: tuple[float, float, float] | None = setting(None, "a place", at_least=-3, at_most=3)
    budget: float | None = setting(None, "seconds", above=0)
    batch: int = setting(8192, "how many", above=0)
    views: int = setting(3, "how many", at_least=2)
    share: float = setting(0.5, "of all", above=0, at_most=1)
    weight: float = setting(1.0, "of a term", at_least=0)
    device: str = setting("cpu", "where")
    verbose: bool = setting(False, "whether to say more")


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_defaults_file_and_overrides_apply_in_this_order(tmp_path):
    path = write(tmp_path, "widths: [64, 64, 64]\nrates: [1e-3, 5.0e-4, 1]\nbudget: 60\nverbose: true\nbatch: 1e4\n")
    loaded = load_config(Settings, path, {"batch": "512", "origin": ["0", "-1e-3", "2"]})
    assert loaded == Settings(
        widths=(64, 64, 64), rates=(1e-3, 5e-4, 1.0), budget=60.0, verbose=True, batch=512, origin=(0.0, -1e-3, 2.0)
    )
    assert isinstance(loaded.budget, float)
    assert isinstance(loaded.rates[2], float)
    assert load_config(Settings) == Settings()
    assert load_config(Settings, str(path)) == load_config(Settings, path)


def test_none_can_be_given_in_a_file_and_by_a_flag(tmp_path):
    assert load_config(Settings, write(tmp_path, "# nothing yet\n")) == Settings()
    path = write(tmp_path, "budget: null\norigin: none\n")
    assert load_config(Settings, path) == Settings()
    assert load_config(Settings, write(tmp_path, "budget: 3"), {"budget": "none"}).budget is None
    assert load_config(Settings, None, {"origin": ["none"]}).origin is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("widht: [1]", r"mine.yaml: unknown key 'widht'; did you mean 'widths'\?$"),
        ("3: [1]", r"mine.yaml: unknown key '3'; known: batch, budget, device"),
        ("widths: 128", r"mine.yaml: widths: got '128', expected a list of whole numbers$"),
        ("widths: [1.5]", r"widths: got '1.5', expected a list of whole numbers$"),
        ("batch: many", r"batch: got 'many', expected a whole number$"),
        ("batch: true", r"batch: got 'True', expected a whole number$"),
        ("budget: .nan", r"budget: got 'nan', expected a finite number, or none$"),
        ("budget: [1]", r"budget: got '1', expected a finite number, or none$"),
        ("origin: [1, 2]", r"origin: got '1 2', expected a list of 3 finite numbers, or none$"),
        ("normals: sometimes", r"normals: got 'sometimes', expected one of auto, file$"),
        ("verbose: 1", r"verbose: got '1', expected true or false$"),
        ("device: 0", r"device: got '0', expected text$"),
        ("batch: -1", r"mine.yaml: batch: -1; expected a whole number > 0$"),
        ("widths: [1]", r"mine.yaml: rates: 2 entries for 1 widths; expected one for each$"),
        ("- 1\n- 2", r"mine.yaml: cannot be read as lines of 'key: value' \(it is a list\)$"),
        ("weight: " + "9" * 400, r"weight: got '9+', expected a finite number$"),
        ("a: b: c", r"mine.yaml: cannot be read .*line 1, column 5"),
        ("a: 2026-13-45", r"mine.yaml: cannot be read .*month must be in"),
        ("[" * 3000, r"mine.yaml: cannot be read .*recursion"),
    ],
)
def test_each_mistake_in_a_file_is_one_line_that_names_it(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        load_config(Settings, write(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"rates": ["fast"]}, r"^--rates: got 'fast', expected a list of finite numbers$"),
        ({"batch": "0.5"}, r"^--batch: got '0.5', expected a whole number$"),
        ({"batch": "0"}, r"^--batch: 0; expected a whole number > 0$"),
        ({"bacht": "1"}, r"^unknown flag --bacht; did you mean '--batch'\?$"),
    ],
)
def test_mistakes_in_flags_are_named_as_flags(overrides, message):
    with pytest.raises(InputError, match=message):
        load_config(Settings, None, overrides)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"widths": ()}, "widths: expected at least one level"),
        ({"widths": (8, 0)}, "widths: (8, 0); expected a list of whole numbers > 0"),
        ({"rates": (0.5, 1.5)}, "rates: (0.5, 1.5); expected a list of finite numbers > 0 and ≤ 1"),
        ({"normals": "none"}, "normals: none; expected one of auto, file"),
        ({"origin": (1, 2, 4)}, "origin: (1, 2, 4); expected a list of 3 finite numbers ≥ -3 and ≤ 3, or none"),
        ({"budget": 0.0}, "budget: 0.0; expected a finite number > 0, or none"),
        ({"budget": math.nan}, "budget: nan; expected a finite number > 0, or none"),
        ({"views": 1}, "views: 1; expected a whole number ≥ 2"),
        ({"share": 0.0}, "share: 0.0; expected a finite number > 0 and ≤ 1"),
        ({"weight": -1e-9}, "weight: -1e-09; expected a finite number ≥ 0"),
    ],
)
def test_fields_say_what_is_allowed(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match="expected") as caught:
        Settings(**wrong)
    assert str(caught.value) == message


def test_bounds_themselves_are_allowed_where_they_belong() -> None:
    Settings(rates=(1.0, 1.0), origin=(-3.0, 0.0, 3.0), views=2, share=1.0, weight=0.0, budget=None)


def test_a_missing_file_and_an_unknown_preset_are_input_errors(tmp_path):
    with pytest.raises(InputError, match=r"absent.yaml: no such file"):
        load_config(Settings, tmp_path / "absent.yaml")
    with pytest.raises(InputError, match="no preset 'slow' for settings"):
        load_config(Settings, "slow")
    (tmp_path / "mine.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"mine.yaml: cannot be read .*utf-8"):
        load_config(Settings, tmp_path / "mine.yaml")


@pytest.mark.parametrize("name", ["fit", "texture", "reconstruct", "evolve"])
def test_the_bundled_presets_are_valid_and_the_defaults_are_the_default_preset(name: str) -> None:
    kind = getattr(config, f"{name.title()}Config")
    presets = {preset: load_config(kind, preset) for preset in config.preset_names(name)}
    assert presets["default"] == kind()
    assert len(set(map(repr, presets.values()))) == len(presets) >= 3


def test_flags_come_from_the_dataclass_and_only_given_ones_override():
    parser = argparse.ArgumentParser()
    config.add_config_flags(parser, Settings)
    arguments = parser.parse_args(["--widths", "32", "64", "--verbose", "--normals", "file", "--batch", "100"])
    given = config.given_flags(arguments, Settings)
    assert given == {"widths": ("32", "64"), "verbose": True, "normals": "file", "batch": "100"}
    assert load_config(Settings, None, given) == Settings(widths=(32, 64), verbose=True, normals="file", batch=100)
    none = config.given_flags(parser.parse_args(["--origin", "none", "--budget", "none"]), Settings)
    assert load_config(Settings, None, none) == Settings()
    assert config.given_flags(parser.parse_args([]), Settings) == {}
    assert config.given_flags(argparse.Namespace(batch=None, verbose=False, other=3), Settings) == {"verbose": False}
    assert "width of each level" in parser.format_help()
    assert "{auto,file}" in parser.format_help()


def test_the_paper_preset_is_the_paper() -> None:
    """(128,2) ▷ (256,2) ▷ (400,2), ω₀ = 30 / 45 / 100, ε = 0.3 and the maximum of Eq. 5."""
    paper = load_config(config.FitConfig, "paper")
    assert (paper.widths, paper.depths, paper.omegas) == ((128, 256, 400), (2, 2, 2), (30.0, 45.0, 100.0))
    assert (paper.epsilon, paper.quantile) == (0.3, 1.0)
