"""Compatibility with ARCSim and DiffSim, which the published experiments used: their integrator, scene files and scenes.

`sim.integrators` and `scene.registry` name this package's modules; nothing else in `sim` and `scene` does.

The integrator is one linearised backward-Euler step, an equation for the velocity change u:

    r(u) = m u - Δt f(u) = 0,   v = v₀ + u,   x = x₀ + Δt v

    f = F(x₀) - H(x₀) (x - x₀ + β v) + m g + f_air(x₀, v₀, v) - strength k_h (x - x*) + contact

The equation is linear: ∂r/∂u is the assembled matrix. β is stiffness-proportional damping. Hard handles replace the rows of
their nodes. (`implicit` has the converged step.)

`integrator` is what the simulation calls, `step` has the episode, `adjoint` and `tangent` its derivatives, `contact`
repulsion, friction and impacts. `load` and `write` have the scene files, `schema` their fields, `release` the published
experiments.
"""
