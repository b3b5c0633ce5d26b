"""Tracks of a run, or the vehicles of a traffic log, in the forms that other programs read."""
