"""Filter of one node (friction hypothesis): prediction, residuals and update."""
