"""Which method for this volume: the cheapest one whose error stays within a budget, judged on the volume itself.

    volume ─┬─▶ survey, reference: points where detail is, the best estimate there ─▶ errors: how far from it ─┐
            └─▶ ways: methods with scheme and storage, and what each costs here ─────────────────────────────┴─▶ choice

Every method is built as it would be used, under the boundary asked for, and compared with the best estimate of the
signal that the samples allow. How far that estimate may be off is calibrated on volumes of known truth; the upper end
of the error must stay within the budget. Costs are measured on this machine.
"""

from filterlab.recommendation.choice import IMAGE, STEPS, TASKS, Candidate, Recommendation, recommend
from filterlab.recommendation.errors import ErrorEstimate

__all__ = ["IMAGE", "STEPS", "TASKS", "Candidate", "ErrorEstimate", "Recommendation", "recommend"]
