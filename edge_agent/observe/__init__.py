"""Estimates along a drive → observations per cell and visit; pure."""
