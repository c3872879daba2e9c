"""Maximum-likelihood estimate of cloth parameters and its uncertainty, for a model that cannot predict the whole
motion.

A frame t has a mean squared distance m from simulated to recorded points, and another one in the opposite direction.
Each has a known variance v. It consists of noise and spacing of the points, 1 mm², and the square of half the
displacement that mesh refinement causes. Further model errors are unknown. So the variances of each frame have a factor
s >= 1, which is chosen by maximum likelihood. With c, the mean of m / v over both directions, s = max(1, c), and

    Φ = Σ_t n (log v_t + ρ(c_t)) + prior,      ρ(c) = c up to 1, 1 + log c above,

is twice the negative log-posterior, for n independent residuals per frame. Model errors are correlated over the cloth,
so n is much smaller than the number of points.

After some time the folding of a cloth is unpredictable, and derivatives explode. Frames are therefore used only up to a
horizon, at which the motions of the refined and the given mesh differ. The refined mesh also corrects the positions:
its displacement is added to the simulated nodes. Half of this displacement is treated as an uncertainty. Recordings
that this simulator made on the same mesh need no correction. For them the horizon only limits the descents, and the
best result is refined on all frames if possible.

The simulation may depart from the recording earlier, for example because its contact is wrong. If c of the best result
exceeds 1.5 in a frame, the descents continue without that frame and the later ones. This is checked after each start.

The variables are those of the space, the pose of each recording, and the size of the grasp if it is unknown. The effect
of the grasp size is interpolated between three sizes, which are centred on the result of the first start. Gauss–Newton
steps, bounded in each variable, run from three starts, and then from two beside the best result. Late frames give Φ many
local minima. The results are weighted by their likelihoods.
"""

from diffcloud.estimation.likelihood.descent import Answer
from diffcloud.estimation.likelihood.energy import FOLLOWS
from diffcloud.estimation.likelihood.estimate import Estimate, estimate
from diffcloud.estimation.likelihood.settings import LikelihoodSettings

__all__ = ["FOLLOWS", "Answer", "Estimate", "LikelihoodSettings", "estimate"]
