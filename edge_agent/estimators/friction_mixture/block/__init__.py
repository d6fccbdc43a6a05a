"""From samples to the features of a block (0.05 s): readings, gaps, wheel slip and grip in use."""
