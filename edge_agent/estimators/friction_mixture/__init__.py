"""The default family: friction as a chain of nodes, each with a square-root cubature filter of the
motion.

In the order of the data: `intake` (a sample is checked and summed), `block_features` (the sums of a
block become what the equations need), `node_filter` with `residuals` and `tyre_curve` (one node is
updated and predicted), `weighing` (what the update means for friction), `mixing` and
`friction_grid` with `split_sides` (the nodes together), `restart`, `step` (the order of all this),
`bank` (what is reported). `constants` holds every number, `design` the tables made of them,
`memory` and `workspace` the records.
"""
