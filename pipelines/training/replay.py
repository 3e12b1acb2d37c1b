"""Steps of a training as CUDA graphs: the host takes longer to ask for a thousand small operations than a GPU to do.

The first step of a kind is done as usual, in fixed shapes, the second is recorded, and others are replayed. What the
host knows, random numbers and rates, comes through a `Supply`.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ...neural_fields.backend.devices import Supply

Results = Mapping[str, Tensor]
Work = Callable[[], Results]


class Recorder(ABC):
    """How a work is recorded."""

    @abstractmethod
    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        """A function that does ``work`` again, and where its results are found afterwards; nothing is done yet."""


# PyTorch waits for the whole device before it records: one thread at a time may do it.
_recording = threading.Lock()


class CudaGraphs(Recorder):
    """CUDA's graphs; all of them share their memory, because one is replayed at a time."""

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        """See `Recorder.record`."""
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.current_stream()
        # The default stream cannot be recorded; PyTorch has one for that. One of `run_streams` can.
        own = None if stream == torch.cuda.default_stream() else stream
        # Others, as one that draws progress, may talk to the device meanwhile.
        with _recording, torch.cuda.graph(graph, pool=self._pool, stream=own, capture_error_mode="thread_local"):
            results = work()
        return graph.replay, results


class Again(Recorder):
    """The work itself, for devices without graphs: what is recorded and replayed can be compared with what is not."""

    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        """See `Recorder.record`."""
        results: dict[str, Tensor] = {}

        def replay() -> None:
            results.update(work())

        return replay, results


@dataclass
class _Kind:
    """A kind of step."""

    supply: Supply  # of what the host hands over
    replay: Callable[[], None] | None  # does it again; None until it is recorded
    results: Results  # of the last time


class Replays:
    """Works by their kinds: done once, recorded by a ``recorder``, and then replayed. At most ``kept`` kinds are kept.

    Where recording fails (another version of PyTorch, no memory left) works are done as they are, and `refused` is why.
    """

    def __init__(self, device: torch.device, recorder: Recorder, *, kept: int = 12) -> None:
        self.device, self.recorder, self.recorded, self.refused = device, recorder, 0, ""
        self.kept = kept
        self._kinds: OrderedDict[Hashable, _Kind] = OrderedDict()

    def do(self, kind: Hashable, work: Work) -> Results:
        """Do a work, directly or by replay; the results are overwritten when a work of the same kind is done again.

        Works of one ``kind`` do the same operations of the device, on the same memory but for what they make; what they
        need of the host is `handed` to them.
        """
        if self.refused:
            return work()
        known = self._kinds.get(kind)
        if known is None:
            return self._first(kind, work)
        self._kinds.move_to_end(kind)
        known.supply.renew()
        if known.replay is None:

            def supplied() -> Results:
                with known.supply.supplied():
                    return work()

            try:
                known.replay, known.results = self.recorder.record(supplied)
            except RuntimeError as error:
                self.refused = str(error).partition("\n")[0]
                self._kinds.clear()
                return work()
            self.recorded += 1
        known.replay()
        return known.results

    def _first(self, kind: Hashable, work: Work) -> Results:
        """Do a work for the first time."""
        supply = Supply(self.device)
        with supply.noting():
            results = work()
        self._kinds[kind] = _Kind(supply, None, results)
        if len(self._kinds) > self.kept:
            self._kinds.popitem(last=False)
        return results
