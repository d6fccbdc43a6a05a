"""Default estimator: a grid of friction hypotheses (nodes), each with a cubature filter of the
motion.

The modules in the order of data flow: `intake` checks a sample and adds it to the sums of the block
(all samples within 0.05 s). `block_features` computes the inputs of the measurement equations from
these sums. `node_filter` with `linearization`, `residuals`, `covariance` and `tyre_curve` updates
and predicts the filters of a group of nodes, which lie side by side in vector registers
(`schemas.runtime.lanes`). `weighing` computes the weights (probabilities) of the nodes from the
result of the update. `mixing` and `friction_grid` with `split_sides` combine the nodes' results.
Then follow `restart`, `step` (the order of all operations) and `bank` (the output). `constants`
holds all numbers, `design` the tables computed from them, `memory` and `workspace` the records.
"""
