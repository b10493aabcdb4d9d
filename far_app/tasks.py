"""The tasks, as data. A new task is one entry here."""

from __future__ import annotations

from far_app.config import TaskConfig
from far_app.errors import ConfigError

TASKS: dict[str, TaskConfig] = {
    "lift": TaskConfig(name="lift", environment="Lift", horizon=150, placement=(0.12, 0.12)),
}


def task(name: str) -> TaskConfig:
    """The entry of that name, or an error that lists the choices."""
    if name not in TASKS:
        raise ConfigError(f"unknown task '{name}'; choose one of: {', '.join(sorted(TASKS))}")
    return TASKS[name]
