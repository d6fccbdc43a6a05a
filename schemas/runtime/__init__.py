"""Technical modules that both packages use: compilation, records, sessions, metrics, process
set-up, figures.
"""
