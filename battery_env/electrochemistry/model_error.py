"""How the error of the model drifts along a discharge: how many independent errors the charge of one shows."""

from __future__ import annotations

from collections.abc import Mapping

from battery_env.compiled import compiled

#: The error of the model is this many times ``mismatch_V`` before ``q_mobile`` and ``r_o`` absorb their shares, which come out
#: under another load: with those that ``fit_cell`` finds of B0005 a new 18650's constants miss its voltage by 81 to 102 mV.
WHOLE_ERROR = 2.0
#: So many independent errors the charge of a whole discharge shows beside a first one, by who asks:
#:
#: - ``forecast``: the model is wrong in another way at another charge, as fast as the residuals of whole discharges of B0005
#:   lose their correlation
#: - ``fit``: what is left of a fit of the constants drifts faster
#: - ``path``: as does the error of a cell at its place along a path of aging cells. Chosen on B0005 along the path of B0006
MORE_ERRORS: Mapping[str, float] = {"forecast": 1.0 / 0.15, "fit": 49.0, "path": 100.0}


@compiled
def independent_errors(charge_C: float, more_per_C: float) -> float:
    """How many independent errors of the model a charge shows."""
    return 1.0 + more_per_C * charge_C


def memory_share(asked_by: str) -> float:
    """The share of ``q_mobile`` over which the error of the model loses its memory."""
    return 1.0 / MORE_ERRORS[asked_by]
