"""Asking the map and watching it, as a third party would."""
