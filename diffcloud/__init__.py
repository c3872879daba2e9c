"""DiffCloud: simulator parameters of a real cloth from the point clouds of its motion.

Imports run one way (a test holds this):

    mesh, io  <-  sim  <-  scene
    clouds    <-  mesh
    fit       <-  sim, scene, clouds
    sensing   <-  mesh, clouds, io
    report    <-  everything but pipeline
"""

__version__ = "0.1.0"
