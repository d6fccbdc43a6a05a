"""Functions behind the commands: live loop, replay of logs, estimators by name, metrics."""
