"""Technical modules that agent and service share: compilation, records, sessions, metrics, process
set-up, figures.
"""
