"""Links of a road network, and which of them each cell and sector of the map lies on."""
