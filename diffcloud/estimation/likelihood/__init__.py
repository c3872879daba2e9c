"""The parameters of a cloth and how well its recordings show them, for a model that cannot predict all of a motion.

A frame t has a mean squared distance m from simulated to recorded points and another from recorded to simulated ones. Each
has a variance v that is known: noise and spacing of the points, one squared millimetre, and the squared half of what a mesh
of half the edge length changes there. What the model lacks beside that is not known, so each frame has a factor s >= 1 on
its variances, which the likelihood chooses. With c the mean of m / v over both ways, s = max(1, c), and

    Φ = Σ_t n (log v_t + ρ(c_t)) + prior,      ρ(c) = c up to 1, 1 + log c above,

is twice the negative logarithm of the likelihood of n independent residuals a frame, and of the priors. Errors of a model
are correlated over a cloth, so n is far below the number of points.

After some time nobody can predict which fold forms: there, derivatives explode. Frames count up to a horizon, where the
finer mesh and the given one part. The finer mesh also corrects the positions: its difference to the given mesh is added to
the simulated nodes. What half of that difference would change is a part of the uncertainty. A recording that this simulator
made on the same mesh needs none of that: there, the horizon bounds the descents, and the best answer goes on with all
frames if it can.

The variables are those of the space, the pose of each recording, and the size of the grasp where that is not known. What
the grasp's size changes is interpolated between three sizes; the first start tells which ones. Gauss and Newton's steps,
bounded in each variable, go from three starts; the answers are weighed by their likelihoods.
"""

from diffcloud.estimation.likelihood.descent import Answer
from diffcloud.estimation.likelihood.estimate import Estimate, estimate
from diffcloud.estimation.likelihood.settings import LikelihoodSettings

__all__ = ["Answer", "Estimate", "LikelihoodSettings", "estimate"]
