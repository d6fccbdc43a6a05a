"""Constants, tables and memory of the friction mixture, and functions that need nothing else."""
