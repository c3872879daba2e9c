"""Contact as ARCSim has it, with its quirks where a scene asks for them: proximity repulsion with lagged friction
inside the
linearised step, then impact zones. Scenes choose by `Surrounding.reference_contact`; the published ones need it."""
