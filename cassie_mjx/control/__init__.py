"""What stands between the robot's state and its PD targets."""
