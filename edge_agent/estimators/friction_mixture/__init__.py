"""The default family: friction as a chain of nodes, each with a square-root cubature filter of the motion."""
