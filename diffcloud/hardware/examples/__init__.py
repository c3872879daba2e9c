"""Drivers to read and to try: a simulated arm of another make, and a camera that is a folder being written.

Both keep the protocols of `diffcloud.hardware.devices`, are named by `arm_driver` and `camera_driver` in
rig.yaml, and pass the conformance tests (docs/drivers.md).
"""
