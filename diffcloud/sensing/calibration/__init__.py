"""Camera calibration: boards, the kinematic chain from gripper to pixel, and checks for wrong inputs."""
