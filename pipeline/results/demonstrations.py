"""What collecting leaves behind."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from oodil.pipeline.artifacts import Artifact, Files, encode_json
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets.native import decode_demonstrations, encode_demonstrations

_DEMONSTRATIONS = "demonstrations.safetensors"
_SOURCES = "demonstrations.json"


@dataclass(frozen=True)
class CollectedDemonstrations:
    """Demonstrations, and how each source's were come by."""

    demonstrations: Demonstrations
    kept_share: tuple[float, ...] = ()
    """By source, the share of collected episodes that were kept; empty for a file."""
    environment_id: str = ""
    transfer_returns: tuple[float, ...] = ()
    """By source, the mean true return of its expert's mean actions under the imitator's own dynamics; NaN for a
    hand-written controller. For reporting alone; empty for a file."""

    def files(self) -> Files:
        """Return the artifact's content."""
        sources = {"kept_share": list(self.kept_share), "transfer_returns": list(self.transfer_returns)}
        return {
            _DEMONSTRATIONS: encode_demonstrations(self.demonstrations, self.environment_id),
            _SOURCES: encode_json(sources),
        }

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        path = str(artifact.path / _DEMONSTRATIONS)
        demonstrations, environment_id = decode_demonstrations(artifact.read(_DEMONSTRATIONS), path)
        sources = artifact.json(_SOURCES)
        returns = tuple(np.nan if each is None else each for each in sources["transfer_returns"])
        return cls(demonstrations, tuple(sources["kept_share"]), environment_id, returns)
