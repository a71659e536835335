"""Which method for this volume: the cheapest one whose error stays within a budget, judged on the volume itself.

    volume ─┬─▶ errors: predicted from the spectrum, measured by leaving samples out ─┐
            └─▶ ways: methods with scheme and storage, what each costs here ──────────┴─▶ choice ──▶ report

Prediction and corrected measurement are two views of the same error that fail for different reasons: what they differ
by is the uncertainty, and the larger of both must stay within the budget. Costs are measured on this machine.
"""

from filterlab.recommendation.choice import IMAGE, STEPS, TASKS, Candidate, Recommendation, recommend
from filterlab.recommendation.errors import ErrorEstimate

__all__ = ["IMAGE", "STEPS", "TASKS", "Candidate", "ErrorEstimate", "Recommendation", "recommend"]
