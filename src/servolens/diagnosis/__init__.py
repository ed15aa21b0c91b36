"""What the simulation gets wrong, its cause, the extended model, and what it gains on held-out data."""

from servolens.diagnosis.result import Candidate, Cause, Diagnosis, Errors, RecordGain
from servolens.diagnosis.workflow import diagnose

__all__ = ["Candidate", "Cause", "Diagnosis", "Errors", "RecordGain", "diagnose"]
