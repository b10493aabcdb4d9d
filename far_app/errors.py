"""The one root of every error an operator may read."""


class FarError(Exception):
    """An error with a message for a person: what, the value, the limit, what to do."""


class ConfigError(FarError):
    """A setting is wrong (unknown task, preset, port, limit)."""


class CheckpointError(FarError):
    """A checkpoint is missing, truncated, of another architecture or made for other observations."""


class RecordingError(FarError):
    """A recording cannot be written (full disk) or read (damaged, other schema)."""


class RobotError(FarError):
    """The robot did not answer, refused a request, or reports an error of its own."""


class ArmTaken(RobotError):
    """Another program leads this arm."""


class GraphicsError(FarError):
    """No GL back end can render the twin's cameras."""


class PolicyError(FarError):
    """The policy produced something no robot may be given (NaN, inf, wrong shape)."""
