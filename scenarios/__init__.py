"""Simulate, run, repeat, compare and report; the command line. Nothing imports this package."""
