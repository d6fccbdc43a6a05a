"""Links of a road network, and the assignment of the map's cells and sectors to them."""
