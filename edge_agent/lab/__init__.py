"""The laboratory: simulation, evaluation and tuning of the estimators. The estimators and the agent
never import the laboratory.
"""
