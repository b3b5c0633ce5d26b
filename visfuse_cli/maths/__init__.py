"""Pure functions on arrays: numpy and scipy only, one idea a file, no config objects."""
