"""Calibration without learning."""

from battery_env.estimates import Estimate as Estimate
from battery_env.estimates import EstimateTrace as EstimateTrace
from battery_env.estimators.cell_fit import CellFit as CellFit
from battery_env.estimators.closed_form import ClosedForm as ClosedForm
from battery_env.estimators.cramer_rao import CramerRaoBound as CramerRaoBound
from battery_env.estimators.cramer_rao import Sensitivities as Sensitivities
from battery_env.estimators.cramer_rao import cramer_rao_bound as cramer_rao_bound
from battery_env.estimators.cramer_rao import sensitivities as sensitivities
from battery_env.estimators.diagnosis.rest import soc_from_rest as soc_from_rest
from battery_env.estimators.estimator import Estimator as Estimator
from battery_env.estimators.estimator import OnlineEstimator as OnlineEstimator
from battery_env.estimators.estimator import Remaining as Remaining
from battery_env.estimators.fit_life import fit_life as fit_life
from battery_env.estimators.joint_fit import fit_cell as fit_cell
from battery_env.estimators.least_squares import LeastSquares as LeastSquares
