"""Scripts that run a cloth in another simulator without diffcloud. `diffcloud export` copies them beside its output,
and the modules `mujoco` and `newton` call them."""
