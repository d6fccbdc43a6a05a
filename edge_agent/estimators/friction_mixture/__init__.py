"""Default estimator of motion and friction. It assumes a grid of friction values (nodes) and runs
one cubature Kalman filter of the vehicle state for each of them.

The modules correspond to the steps of the computation. `intake` checks a sample and adds it to the
sums of the block (all samples within 0.05 s). `block_features` computes the inputs of the
measurement equations from these sums. `node_filter` updates and predicts the filters of a group of
nodes at once, with one node per lane of a vector register (`schemas.runtime.lanes`). It uses
`linearization`, `residuals`, `covariance` and `tyre_curve`. `weighing` computes the weights
(probabilities) of the nodes from the result of the update. `mixing` and `friction_grid` with
`split_sides` combine the nodes' results. `restart` starts and resets a filter, `step` runs all
operations in order, and `bank` writes the output.

Four modules define data. `constants` contains all numbers, and `design` the tables computed from
them. `memory` defines the state of one filter that is kept between samples. `workspace` defines the
scratch arrays of a computation step.
"""
