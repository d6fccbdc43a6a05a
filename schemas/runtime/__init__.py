"""Machinery that both halves start with: compiling, records, batches at speed, sessions, metrics, process, figures."""
