"""Control allocation: from a demanded force and moment to the commands of jets and surfaces, with what remains unmet."""

from allocation.attainable import AttainableSet, attainable_set
from allocation.blending import Handover
from allocation.bound import on_off
from allocation.compare import Comparison, Method, user_method
from allocation.core import Allocation, Effectors
from allocation.demand_history import History
from allocation.predictive import Tradeoff, planner, receding_horizon
from allocation.pseudo_inverse import daisy_chain, redistributed, weighted
from allocation.qp import Weights, allocate, blend, history, weights_for

__all__ = [
    "Allocation",
    "AttainableSet",
    "Comparison",
    "Effectors",
    "Handover",
    "History",
    "Method",
    "Tradeoff",
    "Weights",
    "allocate",
    "attainable_set",
    "blend",
    "daisy_chain",
    "history",
    "on_off",
    "planner",
    "receding_horizon",
    "redistributed",
    "user_method",
    "weighted",
    "weights_for",
]
