"""Recorders of steps for devices without CUDA graphs."""

from collections.abc import Callable

from mplicits.pipelines.training.cuda_graphs import Recorder, Results, Work
from torch import Tensor


class EagerRecorder(Recorder):
    """Runs the work itself again, so that replays can be compared with eager steps."""

    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        """See `Recorder.record`."""
        results: dict[str, Tensor] = {}

        def replay() -> None:
            results.update(work())

        return replay, results
