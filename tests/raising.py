"""A competing method that never gets anywhere. Importing it registers it."""

from oodil.pipeline.artifacts import Files
from oodil.pipeline.stage import JobContext, Run, register
from oodil.pipeline.stages import PolicyStage
from tests.toy import Distance


class Raising(Distance):
    """Raises in every attempt."""

    name = "raising"

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        raise ArithmeticError("no weights today")


register(Raising())
register(PolicyStage("never", title="never", weighting="raising"))
