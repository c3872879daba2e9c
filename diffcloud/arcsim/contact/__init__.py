"""Contact as in ARCSim, including its peculiarities if a scene requests them.

Repulsion with lagged friction acts in the linearised step (`planes`, `proximity`). Impact zones follow. Scenes select the
options by `Surrounding.reference_contact`.
"""
