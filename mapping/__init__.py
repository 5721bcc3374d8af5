"""Strips of many passes to one georeferenced map with sigma, and a corrected track."""
