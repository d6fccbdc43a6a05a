"""Machinery that both packages use: compiler, records, fast batch decoding, sessions, metrics,
process set-up, figures."""
