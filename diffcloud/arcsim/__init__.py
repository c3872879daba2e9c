"""The linearised backward-Euler step, ARCSim's, as an equation for the velocity change u.

    r(u) = m u - Δt f(u) = 0,   v = v₀ + u,   x = x₀ + Δt v

    f = F(x₀) - H(x₀) (x - x₀ + β v) + m g + f_air(x₀, v₀, v) - strength k_h (x - x*) + contact

The equation is linear: ∂r/∂u is the assembled matrix. β is stiffness-proportional damping. Hard handles replace the rows of
their nodes. (`implicit` has the converged step.)

`step` has the episode, `adjoint` and `tangent` its derivatives.
"""

from diffcloud.arcsim.adjoint import reverse
from diffcloud.arcsim.build import build_scene
from diffcloud.arcsim.step import simulate
from diffcloud.arcsim.tangent import tangents

__all__ = ["build_scene", "reverse", "simulate", "tangents"]
