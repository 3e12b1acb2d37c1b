"""What commands share: converters, and how an interrupted one ends."""

import argparse
import re
from contextlib import suppress
from pathlib import Path

import pytest
from mplicits.pipelines.cli.common import Stopped, between, finite, positive, stoppable, training, whole
from mplicits.pipelines.training.trainer import Interrupted


@pytest.mark.parametrize(
    ("convert", "good", "bad", "allowed"),
    [
        (whole(3), {"3": 3, "70000": 70000}, ["2", "3.5", "many", ""], "a whole number from 3"),
        (whole(8, 9), {"8": 8, "9": 9}, ["7", "10", "nan"], "a whole number from 8 to 9"),
        (between(-1, 0.5), {"-1": -1.0, "5e-1": 0.5}, ["-1.01", "0.6", "nan", "half"], "a number from -1 to 0.5"),
        (positive, {"1e-9": 1e-9, "3": 3.0}, ["0", "-1", "inf", "nan", "much"], "a number > 0"),
        (finite, {"-3": -3.0, "0": 0.0}, ["inf", "-inf", "nan", "1,5"], "a number"),
    ],
)
def test_converters_take_what_they_say(convert, good, bad, allowed):
    for text, number in good.items():
        assert repr(convert(text)) == repr(number)
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError, match=re.escape(f"got {text!r}, expected {allowed}")):
            convert(text)


@pytest.mark.parametrize(
    ("stop", "options", "message"),
    [
        (Interrupted(None), {"kept": "go on with --resume"}, "interrupted; go on with --resume"),
        (Interrupted(Path("run")), {}, "interrupted"),
        (KeyboardInterrupt(), {"kept": "the rows are kept", "at_any_time": True}, "interrupted; the rows are kept"),
        (KeyboardInterrupt(), {"kept": "not written yet"}, None),
    ],
)
def test_an_interruption_ends_the_command_with_what_is_kept(stop, options, message):
    for frame in (stoppable(**options), training(quiet=True, **options)):
        said = None
        with suppress(KeyboardInterrupt):
            try:
                with frame:
                    raise stop
            except Stopped as stopped:
                said = str(stopped)
        assert said == message
