"""How good a run is: against truth, against a reference of speeds, or by its own consistency alone."""
