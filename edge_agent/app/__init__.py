"""What the commands run: the live loop, backfill of logs, estimators by name, metrics."""
