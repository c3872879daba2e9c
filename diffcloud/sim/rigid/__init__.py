"""Rigid bodies: six generalised coordinates each, two-way contact with cloth, obstacles and each other."""

from diffcloud.sim.rigid.bodies import Bodies, BodyState, RigidBody

__all__ = ["Bodies", "BodyState", "RigidBody"]
