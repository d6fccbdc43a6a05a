"""Reproduction of the five papers: conditions, figures and tables of each paper."""
