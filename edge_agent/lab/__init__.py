"""What judges and tunes: simulation, evaluation, tuning. Nothing that is judged imports it."""
