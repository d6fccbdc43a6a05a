"""Usability campaign `make usability`: figures about a new user's first hour."""
