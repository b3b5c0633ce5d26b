"""People in the views of several cameras: seen, matched, fused in a closed loop, followed, settled."""
