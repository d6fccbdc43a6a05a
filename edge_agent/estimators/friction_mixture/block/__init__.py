"""Functions that turn the samples of a block (0.05 s) into the inputs of the filter: checked
readings, wheel slip, tyre forces and grip in use.
"""
