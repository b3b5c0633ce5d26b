"""Recorded footage and sensor logs in, trustworthy 3D tracks and speeds out.

Reading order for a newcomer: `records` (what travels), `commands/speed` (a whole run on one page),
`pipeline` (frames, stop requests, timing), then `maths` (one idea a file) with PAPERS.md beside it.
"""

__version__ = "0.1.0"
