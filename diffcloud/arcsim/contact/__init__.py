"""Contact as ARCSim has it, with its quirks where a scene asks for them.

Repulsion with lagged friction acts inside the linearised step (`planes`, `proximity`); then come impact zones. Scenes
choose by `Surrounding.reference_contact`.
"""
