"""The laboratory: simulation, evaluation and tuning. The code under evaluation never imports it."""
