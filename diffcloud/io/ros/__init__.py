"""Read ROS recordings without a ROS installation."""
