"""How well cars that listen are warned, what it costs, and what the map as a prior is worth."""
