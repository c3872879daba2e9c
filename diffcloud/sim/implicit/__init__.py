"""Implicit time integration with smooth contact and rigid bodies: BDF2 or backward Euler, solved by Newton's method.

The unknowns are the velocities w at the end of the step: those of the V cloth nodes, then of each body's centre and its
rotation, D = V + 2 B rows. The equations are the balances of momentum over the step (`rigid.bodies` has those of bodies):

    r(w) = m (w - v̂) - h [ F(x₁) - β H(x₁) w + m g + f_air(x₁, w) - strength k_h (x₁ - x*) + f_contact(x₀, x₁) ] = 0

with x₁ = x̂ + h w. Everything but x̂, v̂ and h is the same for both methods (BDF2 with equal steps):

    backward Euler:  x̂ = x₀,  v̂ = v₀,  h = Δt          BDF2:  x̂ = (4 x₀ - x₋₁)/3,  v̂ = (4 v₀ - v₋₁)/3,  h = 2 Δt/3

The first step of an episode uses backward Euler. So do scenes with rigid bodies, because rotations cannot be combined in
this way. For nodes of hard handles, the equation is w = (x* - x̂)/h.

Newton's matrix is the exact Jacobian, assembled from the derivatives of each element. So the last iterations converge
quadratically, and the same matrix gives exact derivatives of the step. Each Newton step is shortened until the straight
paths of all points are free of collisions, so nothing interpenetrates. Prescribed motion (hard handles, moving obstacles)
advances by the same fraction of its remaining path in each Newton step.

A step that does not converge is halved, down to 1/32. Prescribed motion is linear within the step. `step._weights` has the
BDF2 weights for parts of different lengths.

    reverse:  Jᵀ y = ∂L/∂w,   ∂L/∂p = -(∂r/∂p)ᵀ y          forward:  J ẇ = -(∂r/∂p) ṗ

`integrator` has the interface, `step` the loop over steps, `newton` the solver, and `adjoint` and `tangent` the
derivatives.
"""
