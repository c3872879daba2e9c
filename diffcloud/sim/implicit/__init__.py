"""One converged implicit step with smooth contact and rigid bodies: BDF2 or backward Euler, solved by Newton's method.

The unknowns are the velocities w at the end of the step, of the V cloth nodes, then of each body's centre and its
rotation: D = V + 2 B rows. The equations are the balances of momentum over the step (`rigid.bodies` has those of
bodies):

    r(w) = m (w - v̂) - h [ F(x₁) - β H(x₁) w + m g + f_air(x₁, w) - strength k_h (x₁ - x*) + f_contact(x₀, x₁) ] = 0

with x₁ = x̂ + h w. Backward Euler starts from the last state, x̂ = x₀, v̂ = v₀, h = Δt; BDF2, with equal steps, from
x̂ = (4 x₀ - x₋₁)/3, v̂ = (4 v₀ - v₋₁)/3, h = 2 Δt/3, so that all else is the same for both. Scenes with rigid bodies,
whose rotations have no such sum, are backward Euler's, and so is the first step of an episode. Hard handles replace
their nodes' rows by w = (x* - x̂)/h.

Newton's matrix is the exact Jacobian, assembled from elements (each differentiated on its own), so the last steps
converge quadratically and the same matrix gives exact derivatives of the step. Each Newton step is shortened until
the straight path of all points is free of collisions, so nothing ever passes through anything. Prescribed motion
(hard handles, moving obstacles) takes part in this: it advances with the Newton steps and arrives when they are full.

A step that does not converge is halved, up to 32 parts. Prescribed motion goes straight in between. BDF2 has weights for
parts of different lengths (`step._weights`).

    reverse:  Jᵀ y = ∂L/∂w,   ∂L/∂p = -(∂r/∂p)ᵀ y          forward:  J ẇ = -(∂r/∂p) ṗ

`integrator` is what the simulation calls; `step` has the episode, `newton` the solve, `adjoint` and `tangent` the
derivatives.
"""
