"""Echoes to elevation, and surfaces to labelled regions. Knows no map file, no pose graph, no vehicle."""
