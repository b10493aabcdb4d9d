"""FAR: Failure-Aware Retry, as an application an operator runs beside a robot arm."""

__version__ = "0.1.0"
