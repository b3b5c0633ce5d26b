"""The shipped sample: a rendered clip of a road, points to calibrate from, and the truth about its vehicles."""
