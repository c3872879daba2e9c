"""Where the cameras stand: boards, the chain from gripper to pixel, and what was entered wrongly."""
