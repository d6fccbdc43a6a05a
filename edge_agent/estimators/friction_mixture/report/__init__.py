"""Results of the mixture: interval, beliefs on the friction grid and evidence of a visit."""
