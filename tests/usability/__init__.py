"""Usability campaign: the first hour of a new user as figures. `make usability`."""
