"""The default family: friction as a chain of nodes, each with a square-root cubature filter of the
motion.

Modules in the order of the data: `intake` checks a sample and adds it to the sums of the block.
`block_features` computes the inputs of the equations from these sums. `node_filter` with
`residuals` and `tyre_curve` updates and predicts one node. `weighing` turns the update into weights
of the friction nodes. `mixing` and `friction_grid` with `split_sides` treat the nodes together.
Then follow `restart`, `step` (the order of all this) and `bank` (the output). `constants` holds
every number, `design` the tables made of them, `memory` and `workspace` the records.
"""
