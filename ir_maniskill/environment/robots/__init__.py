"""The Robot module: one file per robot; replacing the robot touches that file only."""
