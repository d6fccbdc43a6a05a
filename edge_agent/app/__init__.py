"""Functions that the commands of `edge-agent` call: live loop, replay of logs, estimators by name,
metrics.
"""
