"""The laboratory: simulation, evaluation and tuning. The evaluated code never imports it."""
