"""Scripts that run a cloth in another simulator without diffcloud: copied beside what `diffcloud export` writes, and what
`mujoco` and `newton` in this package call."""
