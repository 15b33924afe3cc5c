"""The drift of the model error along a discharge: the number of its independent errors per charge."""

from __future__ import annotations

from collections.abc import Mapping

from battery_env.compiled import compiled

#: Ratio of the model error to ``mismatch_V`` before ``q_mobile`` and ``r_o`` absorb their shares, which reappear under another
#: load: with the parameters that ``fit_cell`` gives B0005, a new 18650's constants miss its voltage by 81 to 102 mV.
UNFITTED_ERROR_RATIO = 2.0
#: Number of independent model errors in a whole discharge, in addition to a first one, by purpose:
#:
#: - ``fit``: the residuals of a fit of the constants drift faster
#: - ``path``: the error of a cell at its place along an aging path drifts faster too. Chosen on B0005 along the path of B0006
ERRORS_PER_DISCHARGE: Mapping[str, float] = {"fit": 49.0, "path": 100.0}
#: Correlation length of the model error in a forecast, as a share of ``q_mobile``: that of the residuals of B0005.
CORRELATION_SHARE = 0.15


@compiled
def independent_errors(charge_C: float, errors_per_C: float) -> float:
    """Return the number of independent model errors in a charge."""
    return 1.0 + errors_per_C * charge_C
