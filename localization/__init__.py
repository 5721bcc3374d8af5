"""Position from terrain: what the vehicle senses, matched against a prior map."""
