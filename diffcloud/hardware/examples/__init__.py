"""Example drivers: a simulated UR5e arm, and a camera that reads images from a folder.

Both implement the protocols of `diffcloud.hardware.devices` and pass the conformance tests (docs/drivers.md). Select them
with `arm_driver` and `camera_driver` in rig.yaml.
"""
