"""A city whose streets and speeds are real, and a country made of what its vehicles reported."""
