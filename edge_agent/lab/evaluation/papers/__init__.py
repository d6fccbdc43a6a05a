"""Reproduction of the five papers: the conditions, plots and tables of each paper."""
