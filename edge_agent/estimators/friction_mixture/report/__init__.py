"""Results of the friction mixture: reported interval, friction beliefs, and evidence of a visit
(passage of one map cell).
"""
