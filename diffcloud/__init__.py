"""DiffCloud: simulator parameters of a real cloth from the point clouds of its motion.

Imports run one way (a test holds this):

    mesh, io  <-  sim  <-  scene
    clouds    <-  mesh, io
    fit       <-  sim, scene, clouds
    datasets  <-  sim, scene, clouds
    evaluation <- fit, scene, clouds
    regressors <- mesh, clouds, io
    sensing   <-  mesh, clouds, io
    hardware  <-  sensing, io                  (cameras and arm; their packages are imported when one is opened)
    report    <-  everything above
    cli       <-  everything; nothing imports it but pipeline (the stages of `dvc repro`) and studies
"""

__version__ = "0.1.0"
