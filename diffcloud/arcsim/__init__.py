"""Compatibility with ARCSim and DiffSim, which the published experiments used: integrator, scene files and scenes.

Outside this package, only `sim.integrators` and `scene.registry` name its modules.

The integrator is one linearised backward-Euler step, an equation for the velocity change u:

    r(u) = m u - Δt f(u) = 0,   v = v₀ + u,   x = x₀ + Δt v

    f = F(x₀) - H(x₀) (x - x₀ + β v) + m g + f_air(x₀, v₀, v) - strength k_h (x - x*) + contact

The equation is linear: ∂r/∂u is the assembled matrix. β is stiffness-proportional damping. Hard handles replace the rows of
their nodes. (`sim.implicit` instead iterates each step to convergence.)

`integrator` has the interface, `step` the loop over steps, `adjoint` and `tangent` its derivatives, and `contact`
repulsion, friction and impacts. `load` and `write` process scene files, `schema` has their fields, and `release` the
published experiments.
"""
