"""All reading and writing: video, calibration, tables, tracks, run folders."""
