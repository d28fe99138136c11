"""The one family of errors that a user can mend; whatever else is raised is a defect and keeps its traceback."""


class OodilError(Exception):
    """Input, files or machines that cannot be used; the message names the value and what is allowed."""


class ConfigError(OodilError):
    """A configuration that cannot be used; the message names the key, the value and what is allowed."""


class DataError(OodilError):
    """Demonstrations that cannot be used; the message names the demonstration, the value and the limit."""


class ExpertError(OodilError):
    """An expert that is missing, damaged, or does not fit; the message names its folder."""


class UnusableEnvironmentError(OodilError):
    """An environment that cannot be made, learned in, or put where it should be; the message names its id."""


class NotFinishedError(OodilError):
    """Something was asked of a stage that is not finished, or whose artifact is stale."""


class DamagedArtifactError(OodilError):
    """A file of a finished artifact is missing or does not have the bytes that its manifest names."""


class StorageError(OodilError):
    """A folder or a disk that does not take what is to be written; the message names it."""


class UnfinishedError(OodilError):
    """A stage failed or was stopped; what was finished is kept."""

    def __init__(self, message: str, stage: str, failed: dict[str, str], is_final: bool = False) -> None:
        super().__init__(message)
        self.stage = stage
        self.failed = failed
        """The first traceback, or how it died, of each job that failed; empty after a stop."""
        self.is_final = is_final
        """Whether all of them failed for a reason that another attempt would meet again."""
