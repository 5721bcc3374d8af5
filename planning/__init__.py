"""Routes near the bottom, within the vehicle's limits, proved clear."""
