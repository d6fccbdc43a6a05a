"""From the archive back to what a service knows: restarts, checkpoints and past moments."""
