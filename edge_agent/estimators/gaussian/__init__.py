"""Parts that the papers' filters share: a bank with one Gaussian per vehicle, the intake of
samples, planar motion.
"""
