"""The registered full-state tasks; the docstring of each is the page of its environments."""

from __future__ import annotations

from battery_env.tasks.full_state.layout import LITERAL
from battery_env.tasks.full_state.task import FullStateTask


class BatteryQmax(FullStateTask):
    """
    ## Description

    A Li-ion cell of unknown age is discharged at a constant power of 8 to 16 W, and its whole state is measured once a
    second. Find q_max (``q_mobile``), the charge that can move, by making NASA's electrochemistry model follow the measured
    state. Source: Unagar et al. 2020; no label is used, and the reward does not know the true parameter.

    ## Observation space

    ``Box(-100, 100, (29,), float32)``. States are Vo, Vsn, Vsp (divided by 0.5, 0.1, 0.01 V), qnB, qnS, qpB, qpS (divided by
    6840, 760, 11400, 1266 C).

    | index | content |
    |-------|---------|
    | 0-6   | x̂_t, the model's state |
    | 7-13  | x_{t+1}, the measured state one step ahead |
    | 14    | u_{t+1}, the power over that step, divided by 16 W |
    | 15-21 | asinh of the innovation x_{t+1} minus what the model with a new cell's parameters predicts from x̂_t, in error scales |
    | 22-28 | asinh of the innovation x_{t+1} minus what the model with a new cell's parameters predicts from x_t, the state measured before, in error scales |

    Error scales: Vo 0.01 V, Vsn and Vsp 1e-5 V, charges 20 C. The two innovations make the measurements readable: a parameter
    that is off by 1 % moves the next state by 1e-4 of its value. The second one shows what the parameter did in this second.
    The first one shows besides how far the model has drifted, which is most of the cost. A model that was wrong for minutes is
    off by up to thousands of error scales (median 13, one in a hundred above 1600, under random actions). asinh keeps what a
    network sees within about 10, and leaves small innovations as they are.

    The observation is Markov for a constant load: cost and next model state depend on it and the action alone, the next
    measured state on the parameter too, which the observation determines. It stays so with ``initial_perturbation``,
    ``consistency`` (which appends what is needed) and ``resync`` = 1. It is not Markov, though the cost of a decision still
    depends on observation and action alone, with a load that changes (when, is hidden), ``resync`` > 1 (so is the step in the
    cycle) or ``mismatch`` (so are constants of the cell).

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to q_mobile = 3500 .. 8100 C. R_o is known.

    ## Reward

    Minus the cost, the error of Vsp in x̂_{t+1} in error scales, at most 5. A wrong q_mobile moves Vsp at once, and the model
    forgets the error in a minute. Vsn keeps old errors for a quarter of an hour and the charges for ever, which would outweigh
    what the last decision did.

    ## Starting state

    A random second of a random discharge of the training part (70 %) of the paper's data: eleven loads times 501 values
    of q_mobile in 4000 .. 7000 C, without the first and last 5 % of each discharge. The model starts in the true state.
    ``reset(options=...)`` takes ``trajectory`` and ``sample`` (counted from the start of the discharge) in place of random ones.

    ## Episode end

    Truncated after 64 steps (more with ``continue_probability``), or where the data end. Never terminated.

    ## Arguments

    | argument | default | meaning |
    |----------|---------|---------|
    | ``episode_steps`` | 64 | decisions per episode |
    | ``continue_probability`` | 0 | probability that an episode goes on for another ``episode_steps``, and after these again; drawn at its start. Takes the model where the policy's own errors do in a whole discharge |
    | ``first_sample_probability`` | 0 | probability that an episode starts at the first sample of the whole discharge, at rest, in place of a random one. The data have little of the seconds after it: they leave out the first 5 % of each discharge |
    | ``initial_perturbation`` | 0 | the first state is off by a uniform draw within this many error scales to either side, in Vo, Vsn, Vsp and in charge that has moved between the electrodes. Teaches policies to stand a state of the model that is not exact |
    | ``resync`` | none | the model is set to the measured state after every so many decisions |
    | ``consistency`` | 0 | cost of a change of the action per unit of its Euclidean length (the paper's consistency penalty); above 0 the action before is appended to the observation, at first the one that stands for a new cell |
    | ``cost_limit`` | 5 | largest cost of a parameter, without that of a change |
    | ``load`` | ``"paper"`` | or ``"constant"``, ``"piecewise"``, ``"random_walk"``, ``"recorded"``: see ``battery_env.tasks.data.standard_dataset``; cells whose parameters no action stands for are left out |
    | ``split`` | ``"train"`` | or ``"test"``, ``"all"`` |
    | ``dt_s`` | 1 | time step, s |
    | ``mismatch`` | 0 | how far kn, tDiffusion, to and tsn of the cell are from the model's (relative standard deviation) |
    | ``dataset`` | none | a ``TrajectoryDataset`` to draw from, or the file of a saved one, in place of the last four |
    | ``render_mode`` | none | ``"rgb_array"`` |

    ``gymnasium.make_vec`` takes ``num_envs`` and ``autoreset_mode`` besides.

    ## Info

    ``cost``; ``q_mobile``, ``r_o`` (true), ``q_mobile_hat``, ``r_o_hat`` (the model's), C and ohm; ``voltage`` and
    ``voltage_hat`` of cell and model, V; ``soc``, the state of charge of the cell.

    ## Version history

    * v0: initial version; since 0.2.0 with the second innovation; since 0.3.0 with asinh of both; since 0.4.0 with actions
      beyond the oldest cells, and a cost of the voltage that shows the parameter in place of all states
    """  # noqa: E501 (rows of a table)

    parameters = ("q_mobile",)


class BatteryRo(FullStateTask):
    """
    ## Description

    As ``BatteryQmax-v0``, but R_o (``r_o``), the ohmic resistance, is to be found, and q_mobile is known.

    ## Observation space

    ``Box(-100, 100, (29,), float32)``, laid out and scaled as in ``BatteryQmax-v0``.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to r_o = 0.08 .. 0.22 ohm.

    ## Reward

    As ``BatteryQmax-v0``, with the error of Vo, which shows a wrong R_o at once and forgets it in seconds.

    ## Starting state

    As ``BatteryQmax-v0``, with 501 values of r_o in 0.1 .. 0.2 ohm.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``.

    ## Version history

    * v0: initial version
    """

    parameters = ("r_o",)


class BatteryQmaxPaper(FullStateTask):
    """
    ## Description

    The q_max task in the literal form of the paper and its code, for comparison with ``BatteryQmax-v0``.

    ## Observation space

    ``Box(-100, 100, (15,), float32)``: x̂_t, x_{t+1} and u_{t+1}, divided by the new cell's charges (6840, 760, 4560, 506.67 C
    for qnB, qnS, qpB, qpS), 1 V and 20 W.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to q_mobile = 4000 .. 8000 C. R_o is known.

    ## Reward

    Minus the cost: 0.5 times the norm of the error of the voltages in V plus 0.5 times that of the charges in C, times 50
    where that exceeds 1e-4; at most 10000.

    ## Starting state

    As ``BatteryQmax-v0``.

    ## Episode end

    Truncated after 16 steps, or where the data end. Never terminated (the authors' code treats the end as terminal; here a
    time limit is one).

    ## Arguments

    Those of ``BatteryQmax-v0``, with ``episode_steps`` 16 and ``cost_limit`` 10000; error scales are the same.

    ## Version history

    * v0: initial version
    """

    parameters = ("q_mobile",)
    formulation = LITERAL
    episode_steps = 16


class BatteryRoPaper(FullStateTask):
    """
    ## Description

    The R_o task in the literal form of the paper and its code, for comparison with ``BatteryRo-v0``.

    ## Observation space

    ``Box(-100, 100, (15,), float32)``, laid out and scaled as in ``BatteryQmaxPaper-v0``.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to r_o = 0.08 .. 0.22 ohm. q_mobile is known.

    ## Reward

    That of ``BatteryQmaxPaper-v0``.

    ## Starting state

    As ``BatteryRo-v0``.

    ## Episode end

    Truncated after 16 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``, with ``episode_steps`` 16 and ``cost_limit`` 10000; error scales are the same.

    ## Version history

    * v0: initial version
    """

    parameters = ("r_o",)
    formulation = LITERAL
    episode_steps = 16


class BatteryJoint(FullStateTask):
    """
    ## Description

    As ``BatteryQmax-v0``, but q_max and R_o (``r_o``), the ohmic resistance, have both aged and are to be found together.

    ## Observation space

    ``Box(-100, 100, (29,), float32)``, laid out and scaled as in ``BatteryQmax-v0``, and Markov under the same conditions. An
    R_o that is off shows in Vo alone (0.8 error scales for 10 %), a q_mobile in all three voltages (0.1, 0.1 and 0.2).

    ## Action space

    ``Box(-1, 1, (2,), float32)``, mapped linearly to q_mobile = 3500 .. 8100 C and r_o = 0.08 .. 0.22 ohm.

    ## Reward

    Minus the sum of the costs of ``BatteryQmax-v0`` and ``BatteryRo-v0``, each at most 5.

    ## Starting state

    A random second of a random discharge of the training part (700 of 1000 discharges), with q_mobile in 4000 .. 7000 C and
    r_o in 0.1 .. 0.2 ohm drawn independently, eleven loads of 8 to 16 W, without the first and last 5 % of each discharge. The
    model starts in the true state.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``.

    ## Version history

    * v0: initial version
    """

    parameters = ("q_mobile", "r_o")
