"""Files: reading what may be damaged or hostile, writing so that a crash leaves nothing half-written."""
