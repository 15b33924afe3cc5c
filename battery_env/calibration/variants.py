"""The registered full-state environments; the docstring of each is its page."""

from __future__ import annotations

from typing import Any

from battery_env.calibration.env import FullStateEnv


class BatteryQmaxEnv(FullStateEnv):
    """
    ## Description

    A Li-ion cell of unknown age is discharged at a constant power of 8 to 16 W, and its whole state is measured once a
    second. Find q^max (``q_mobile``), the charge that can move, by making NASA's electrochemistry model follow the measured
    state. Source: Unagar et al. 2020; no label is used, and the reward does not know the true parameter.

    ## Observation space

    ``Box(-100, 100, (22,), float32)``. States are Vo, Vsn, Vsp (divided by 0.5, 0.1, 0.01 V), qnB, qnS, qpB, qpS (divided by
    6840, 760, 11400, 1266 C).

    | index | content |
    |-------|---------|
    | 0-6   | x̂_t, the model's state |
    | 7-13  | x_{t+1}, the measured state one step ahead |
    | 14    | u_{t+1}, the power over that step, divided by 16 W |
    | 15-21 | the innovation: x_{t+1} minus what the model with a new cell's parameters predicts from x̂_t, in error scales |

    Error scales: Vo 0.01 V, Vsn and Vsp 1e-5 V, charges 20 C. The innovation holds nothing that is not in the rest of the
    observation, but makes it readable: a parameter that is off by 1 % moves the next state by 1e-4 of its value. The
    observation is Markov for a constant load: cost and next model state depend on it and the action alone, the next measured
    state on the parameter too, which the observation determines.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to q_mobile = 4000 .. 8000 C. R_o is known.

    ## Reward

    Minus the cost, the Euclidean norm of x̂_{t+1} - x_{t+1} in error scales, at most 5.

    ## Starting state

    A random second of a random discharge of the training part (70 %) of the paper's data: eleven loads times 501 values
    of q_mobile in 4000 .. 7000 C, without the first and last 5 % of each discharge. The model starts in the true state.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    ``episode_steps`` (64), ``initial_perturbation`` (0: in error scales, uniform to either side in Vo, Vsn, Vsp
    and in charge that has moved between the electrodes), ``split``
    (``"train"``, ``"test"`` or ``"all"``), ``dataset`` (a ``TrajectoryDataset`` to draw from instead), ``render_mode``.

    ## Version history

    * v0: initial version
    """

    def __init__(self, episode_steps: int = 64, **arguments: Any) -> None:
        super().__init__("q_mobile", "scaled", episode_steps, **arguments)


class BatteryRoEnv(FullStateEnv):
    """
    ## Description

    As ``BatteryQmax-v0``, but R_o (``r_o``), the ohmic resistance, is to be found, and q_mobile is known.

    ## Observation space

    ``Box(-100, 100, (22,), float32)``, laid out and scaled as in ``BatteryQmax-v0``.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to r_o = 0.08 .. 0.22 ohm.

    ## Reward

    That of ``BatteryQmax-v0``.

    ## Starting state

    As ``BatteryQmax-v0``, with 501 values of r_o in 0.1 .. 0.2 ohm.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``.

    ## Version history

    * v0: initial version
    """

    def __init__(self, episode_steps: int = 64, **arguments: Any) -> None:
        super().__init__("r_o", "scaled", episode_steps, **arguments)


class BatteryQmaxPaperEnv(FullStateEnv):
    """
    ## Description

    The q^max task in the literal form of the paper and its code, for comparison with ``BatteryQmax-v0``.

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

    Those of ``BatteryQmax-v0``, with ``episode_steps`` 16.

    ## Version history

    * v0: initial version
    """

    def __init__(self, episode_steps: int = 16, **arguments: Any) -> None:
        super().__init__("q_mobile", "paper", episode_steps, **arguments)


class BatteryRoPaperEnv(FullStateEnv):
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

    Those of ``BatteryQmax-v0``, with ``episode_steps`` 16.

    ## Version history

    * v0: initial version
    """

    def __init__(self, episode_steps: int = 16, **arguments: Any) -> None:
        super().__init__("r_o", "paper", episode_steps, **arguments)
