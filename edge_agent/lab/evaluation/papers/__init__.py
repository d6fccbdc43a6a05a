"""Reproduction of the five papers: each paper's conditions, figures and tables, one paper at a
time."""
