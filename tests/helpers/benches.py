"""What tests of benchmarks share: settings of small fits, and a method of the paper's tables that knows the answer."""

from mplicits.neural_fields import Similarity, Sphere
from mplicits.pipelines.training.settings import FitConfig

from benchmarks.harness.jobs import Method, Results
from benchmarks.paper.jobs import PaperJob
from benchmarks.paper.judge import Judge

SMALL = FitConfig(
    widths=(32, 32), depths=(2, 2), omegas=(10.0, 15.0), steps=(120, 40), learning_rates=(4e-3, 1e-3), batch=1024,
    samples=10_000,
)  # fmt: skip
RADIUS, PLACE = 0.7, Similarity((5.0, 0.0, -1.0), 20.0)  # of the ball


class Exact(Method[PaperJob]):
    """Knows the ball, or one of another radius; fails where that is None."""

    source, differs = "a test", "nothing"

    def __init__(self, name: str = "exact", radius: float | None = RADIUS, *, title: str = "Exact") -> None:
        self.name, self.radius, self.title, self.runs = name, radius, title, 0

    def run(self, job, context):
        self.runs += 1
        if self.radius is None:
            raise RuntimeError("no\nluck")
        field = Sphere(radius=self.radius)
        figures = Judge(job, context).field(self.title, field, PLACE, parameters=1, train_seconds=2.0)
        return Results((figures,), (0.25,))
