"""Steps of a training as CUDA graphs: launching a thousand small operations takes longer than a GPU needs for them.

The first step of a kind runs eagerly, in fixed shapes; the second is recorded, and later ones are replayed. Random
numbers and learning rates come from the host as `GraphInputs`.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ...neural_fields.backend.devices import GraphInputs

Results = Mapping[str, Tensor]
Work = Callable[[], Results]


class Recorder(ABC):
    """Records work for replay."""

    @abstractmethod
    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        """A function that runs ``work`` again, and the tensors that receive its results; nothing runs yet."""


# PyTorch waits for the whole device before it records: one thread at a time may do it.
_recording = threading.Lock()


class CudaGraphRecorder(Recorder):
    """Records CUDA graphs; all of them share one memory pool, because one is replayed at a time."""

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


@dataclass
class _Graph:
    """The graph of a kind of step."""

    inputs: GraphInputs
    replay: Callable[[], None] | None  # runs it again; None until it is recorded
    results: Results  # of the last run


class GraphCache:
    """Graphs by kind of step: run eagerly once, recorded by a ``recorder``, then replayed. At most ``kept`` are kept.

    Where recording fails (another version of PyTorch, no memory left), all work runs eagerly; `refused` is the reason.
    """

    def __init__(self, device: torch.device, recorder: Recorder, *, kept: int = 12) -> None:
        self.device, self.recorder, self.recorded, self.refused = device, recorder, 0, ""
        self.kept = kept
        self._graphs: OrderedDict[Hashable, _Graph] = OrderedDict()

    def run(self, kind: Hashable, work: Work) -> Results:
        """Run ``work``, eagerly or by replay; the next run of the same ``kind`` overwrites the results.

        Work of one kind launches the same operations, on the same memory except for its temporaries. Each input from
        the host is a `graph_input`.
        """
        if self.refused:
            return work()
        graph = self._graphs.get(kind)
        if graph is None:
            return self._run_first(kind, work)
        self._graphs.move_to_end(kind)
        graph.inputs.update()
        if graph.replay is None:

            def with_inputs() -> Results:
                with graph.inputs.static():
                    return work()

            try:
                graph.replay, graph.results = self.recorder.record(with_inputs)
            except RuntimeError as error:
                self.refused = str(error).partition("\n")[0]
                self._graphs.clear()
                return work()
            self.recorded += 1
        graph.replay()
        return graph.results

    def _run_first(self, kind: Hashable, work: Work) -> Results:
        """Run work of a new kind eagerly."""
        inputs = GraphInputs(self.device)
        with inputs.recording():
            results = work()
        self._graphs[kind] = _Graph(inputs, None, results)
        if len(self._graphs) > self.kept:
            self._graphs.popitem(last=False)
        return results
