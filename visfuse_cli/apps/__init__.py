"""What stands on the commands: the demo now, more to come."""
