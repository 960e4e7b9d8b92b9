"""What stands around the robot: the room with its table, and the shapes on it."""
