"""A pan-tilt head that watches the ground: what moves there, by gaze angles and a homography (Bradshaw 1997)."""
