"""Things followed on the ground plane: predict, measure around the prediction, update, and conclude."""
