"""Recordings of ROS, without ROS."""
