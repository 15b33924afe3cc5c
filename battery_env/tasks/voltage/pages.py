"""The registered voltage-only tasks; the docstring of each is the page of its environments."""

from __future__ import annotations

from battery_env.tasks.voltage.task import VoltageTask


class BatteryVoltageJoint(VoltageTask):
    """
    ## Description

    A Li-ion cell of unknown age is discharged from full charge under a power that changes every one or two minutes. Current
    and terminal voltage are read every ten seconds; no state of the cell is measured. Find both parameters that age,
    q_max (``q_mobile``, the charge that can move) and R_o (``r_o``, the ohmic resistance), by explaining all readings so far
    with one pair of them. The paper (Unagar et al. 2020) names this as future work. By default no label is used: the reward
    knows readings and estimate alone, so that the task can be made of recorded discharges too.

    The voltage of the model for any (q_mobile, r_o) at all readings so far costs no simulation: see
    ``battery_env.tasks.voltage.readings.Readings``.

    ## Observation space

    ``Box(-100, 100, (102,), float32)``. The readings so far are cut into 16 stretches of equal length, each of these into the
    readings with less and with more current than its mean (pairs in this order below). A residual is the measured minus the
    modelled voltage at the estimate; the misfit is the root mean square of the 32 mean residuals, less the one offset within
    ``offset_V`` that explains them best.

    | index | content |
    |-------|---------|
    | 0-31  | mean residual of each part less that offset, over the misfit plus 1 mV |
    | 32-63 | mean sensitivity dV/dq_mobile of each part, asinh of its ratio to 50 microvolts per coulomb |
    | 64-95 | mean -dV/dr_o of each part (the current that has settled in the ohmic drop), divided by 3 A |
    | 96    | logarithm of the misfit plus 0.1 mV over 10 mV |
    | 97    | logarithm of the root mean square of all residuals plus 0.1 mV over 10 mV |
    | 98    | asinh of the mean residual over 10 mV |
    | 99    | time since the start of the discharge, divided by 3000 s |
    | 100-101 | the estimate: q_mobile = 3500 .. 8100 C and r_o = 0.05 .. 0.35 ohm as -1 .. 1 |

    With ``nuisance`` above 0 ten more numbers follow, of one Gauss-Newton step of a fit of everything that is not known: both
    parameters, the offset of the sensor, and the logarithms of the factors by which kn, tDiffusion, to and tsn of the cell differ
    from the model's. Each has a prior: normal, with the mean and the standard deviation of the ranges above, of the bounds of the
    offset, and with ``nuisance`` for the factors. The noise is what the step leaves of the residuals. The factors are kept from
    one decision to the next, as the estimate is.

    | index | content |
    |-------|---------|
    | 102-103 | the action that would make this step of q_mobile and r_o |
    | 104-105 | logarithm of the standard deviation that the fit states of each, over 1 % of the range of the estimate |
    | 106   | logarithm of the noise over 10 mV |
    | 107   | asinh of the offset over 10 mV |
    | 108-111 | logarithms of the four factors, over ``nuisance`` |

    With a ``path`` of aging cells (``battery_env.fit_life``) the fit allows for all that ages along it, under one prior of what
    goes together there: both parameters, the four factors, and eight coefficients of the equilibrium voltage. It expects the error
    of the model that the path states, and moves q_mobile by a tenth at most. 108-119 are the factors and the coefficients, less
    their means, over their standard deviations.

    Not Markov in the strict sense: the next cost depends on readings that have not arrived, and on those so far through more
    than their means. For the estimate of constant parameters the observation is nearly sufficient: residuals and
    sensitivities are what a Gauss-Newton step is made of. Noise, offset and errors of the current sensor are constant within
    an episode and not observed.

    ## Action space

    ``Box(-1, 1, (2,), float32)``: the estimate of q_mobile and r_o moves by sign(a) a^2 times 1500 C and 0.12 ohm, and is
    kept within the ranges above. With a ``path`` the action says how far from the fit's the estimate is to be: it becomes that of
    the fit plus 2 a of its standard deviations.

    ## Reward

    Minus the cost: asinh of the misfit over 2 mV, at the new estimate and with the new readings.

    With ``cost="state"`` the cost is the error of the model's hidden state, as in the paper. The charges are linear in
    q_mobile, and the ohmic drop is linear in r_o, so that it comes down to the relative errors of the estimate: asinh of
    the root of their sum of squares over 1 %. The simulator knows it while the policy is trained. The policy does not see
    it, and does not need it at run time. It matters where the model is wrong (``mismatch``): there the pair of parameters
    with the least misfit is not the true one.

    ## Starting state

    A random reading of a random discharge of the training part (700 of 1000 discharges, q_mobile = 4000 .. 7600 C,
    r_o = 0.1 .. 0.3 ohm, 2 to 8 W), a random estimate, and a sensor whose noise has a standard deviation of 1 to 30 mV
    (log-uniform) and whose offset is within 10 mV to either side. Between two decisions 0 to 29 new readings arrive, as long
    as there are any.

    ## Episode end

    Truncated after 8 decisions. Never terminated.

    ## Arguments

    | argument | default | meaning |
    |----------|---------|---------|
    | ``episode_steps`` | 8 | decisions per episode |
    | ``reading_s`` | 10 | least time between two readings, s, which are taken at samples; (least, most): simulated discharges have irregular ones, of a mean between both that is drawn for each |
    | ``new_readings`` | (0, 29) | fewest and most readings between two decisions |
    | ``noise_V`` | (0.001, 0.030) | least and greatest standard deviation of the voltage sensor's noise, V |
    | ``offset_V`` | 0.010 | bound of the voltage sensor's offset, V; known to the agent |
    | ``current_gain`` | 0 | bound of the relative error of the current sensor's gain |
    | ``current_offset_A`` | 0 | bound of the current sensor's offset, A |
    | ``process_noise_V`` | 0 | noise on Vo, Vsn and Vsp of the cell, V per root of a second |
    | ``measured`` | ``"current"`` | or ``"power"``: the current is the measured power over the measured voltage |
    | ``start`` | ``"random"`` | first estimate; or ``"new_cell"``, ``"true"`` |
    | ``consistency`` | 0 | cost of a change of the action per unit of its length (the paper's consistency penalty); above 0 the action before is appended to the observation |
    | ``cost`` | ``"misfit"`` | or ``"state"``: the error of the model's hidden state, for simulated discharges |
    | ``load`` | ``"piecewise"`` | or ``"constant"``, ``"random_walk"``, ``"recorded"`` |
    | ``split`` | ``"train"`` | or ``"test"``, ``"all"`` |
    | ``dt_s`` | 1 | time step of the cell, s |
    | ``mismatch`` | 0 | how far kn, tDiffusion, to and tsn of the cell are from the model's (relative standard deviation) |
    | ``nuisance`` | 0 | how far the agent is to take them to be; above 0 the observation has a fit that allows for it |
    | ``path`` | none | an ``AgingPath``, or the file of one: the discharges are those of cells along it, and the agent knows what goes together there |
    | ``cell`` | none | constants of the model, an 18650's, as of ``fit_cell``: of the data set, or of a new cell by default |
    | ``dataset`` | none | other discharges from full charge, simulated (or the file of a saved ``TrajectoryDataset``) or recorded, in place of these |
    | ``render_mode`` | none | ``"rgb_array"`` |

    ``reset(options=...)`` takes ``discharge``, ``reading``, ``q_mobile_hat`` and ``r_o_hat``. As the model has no state of
    its own that could drift, there is nothing to resynchronise.

    ## Version history

    * v0: initial version
    """  # noqa: E501 (rows of a table)

    parameters = ("q_mobile", "r_o")


class BatteryVoltageQmax(VoltageTask):
    """
    ## Description

    As ``BatteryVoltageJoint-v0``, but R_o is known (the new cell's in recorded discharges), and q_max (``q_mobile``) is to be
    found.

    ## Observation space

    ``Box(-100, 100, (101,), float32)``, laid out as in ``BatteryVoltageJoint-v0``; the estimate is one number.

    ## Action space

    ``Box(-1, 1, (1,), float32)``: the estimate of q_mobile moves by sign(a) a^2 times 1500 C.

    ## Reward

    That of ``BatteryVoltageJoint-v0``.

    ## Starting state

    As ``BatteryVoltageJoint-v0``, with the new cell's r_o.

    ## Episode end

    Truncated after 8 decisions. Never terminated.

    ## Arguments

    Those of ``BatteryVoltageJoint-v0``.

    ## Version history

    * v0: initial version
    """

    parameters = ("q_mobile",)


class BatteryVoltageRo(VoltageTask):
    """
    ## Description

    As ``BatteryVoltageJoint-v0``, but q_max is known (the new cell's in recorded discharges), and R_o (``r_o``) is to be
    found.

    ## Observation space

    ``Box(-100, 100, (101,), float32)``, laid out as in ``BatteryVoltageJoint-v0``; the estimate is one number.

    ## Action space

    ``Box(-1, 1, (1,), float32)``: the estimate of r_o moves by sign(a) a^2 times 0.12 ohm.

    ## Reward

    That of ``BatteryVoltageJoint-v0``.

    ## Starting state

    As ``BatteryVoltageJoint-v0``, with the new cell's q_mobile.

    ## Episode end

    Truncated after 8 decisions. Never terminated.

    ## Arguments

    Those of ``BatteryVoltageJoint-v0``.

    ## Version history

    * v0: initial version
    """

    parameters = ("r_o",)
