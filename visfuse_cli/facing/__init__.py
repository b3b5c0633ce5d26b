"""The front of a vehicle before a static stereo pair: found, tracked by particles, measured, settled."""
