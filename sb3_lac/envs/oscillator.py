from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_lac.envs.base import Axes, CostEnv, stated_parameters


class OscillatorEnv(CostEnv):
    """
    ## Description

    The oscillator is a gene network, the repressilator: three messengers m and their proteins p, each of which represses the
    next messenger. The first protein has to follow a sine by light that drives the messengers: the tracking task of Han et
    al. (2020), after Elowitz and Leibler (2000).

    With j = 3, 1, 2 for i = 1, 2, 3 and steps of dt = 1:

        m_i' = transcription / (half_saturation + p_j^2) - messenger_decay * m_i + light * u_i
        p_i' = translation * m_i - protein_decay * p_i

    ## Action Space

    Three numbers in [-1, 1], mapped to light u in [0, 1].

    ## Observation Space

    | index | variable | range |
    | --- | --- | --- |
    | 0 - 2 | messengers m_1, m_2, m_3 | 0 .. 1000 |
    | 3 - 5 | proteins p_1, p_2, p_3 | 0 .. 1000 |
    | 6 | reference now, r(t) | 0 .. 1000 |
    | 7 | reference of the next step, r(t+1) | 0 .. 1000 |

    The reference is `r(t) = 8 + 7 sin(2 pi t / 200)`; its two values tell the phase, so that the observation is Markov.

    ## Cost

    `(p_1 - r)^2` of the next state, with the reference of that step. The reward is minus the cost.

    `info["error"]` is abs(p_1 - r), the distance of the first protein from its reference.

    ## Starting State

    Messengers and proteins are uniform in 0 .. 5, and the reference starts at t = 0.

    ## Episode End

    No termination. Truncation: 400 steps, two periods.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `transcription` | 1.6 | largest rate of transcription |
    | `half_saturation` | 1.0 | repression: squared protein at half the rate |
    | `messenger_decay` | 0.16 | rate at which messengers decay |
    | `light` | 5.0 | effect of full light |
    | `translation` | 0.16 | rate at which messengers make proteins |
    | `protein_decay` | 0.06 | rate at which proteins decay |

    and the [disturbances](../cost_environments.md#disturbances) of all cost environments. `impulse` is an amount of the first
    protein.

    ## Reference Controller

    Inversion of the model costs 0.31 per step on average over 100 episodes, all of it in the first steps. 100 of 100 end with
    an error below 0.1, the largest is 1.3e-7.

    ## Version History

    * v0: first version
    """

    state_names = ("m1", "m2", "m3", "p1", "p2", "p3")
    error_name = "distance of the first protein from its reference"
    error_tolerance = 0.1
    transcription: float = 1.6
    half_saturation: float = 1.0
    messenger_decay: float = 0.16
    light: float = 5.0
    translation: float = 0.16
    protein_decay: float = 0.06

    PERIOD_STEPS = 200
    STATE_MAX = 1000.0

    def __init__(self, **options: Any) -> None:
        parameters = stated_parameters(OscillatorEnv, options)
        observation_space = spaces.Box(0.0, self.STATE_MAX, (8,), np.float32)
        super().__init__(parameters, np.zeros(6), np.full(6, self.STATE_MAX), observation_space, n_actions=3, **options)

    def reference(self, step: int) -> float:
        """Return what the first protein should be so many steps after the start."""
        return 8.0 + 7.0 * float(np.sin(2.0 * np.pi * step / self.PERIOD_STEPS))

    def _initial_state(self) -> np.ndarray:
        return self.np_random.uniform(0.0, 5.0, 6)

    def _observation(self) -> np.ndarray:
        return np.array([*self.state, self.reference(self.n_steps), self.reference(self.n_steps + 1)], dtype=np.float32)

    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        messengers, proteins = state[:3], state[3:]
        repression = self.transcription / (self.half_saturation + proteins[[2, 0, 1]] ** 2)
        messenger_rate = repression - self.messenger_decay * messengers + self.light * 0.5 * (action + 1.0)
        protein_rate = self.translation * messengers - self.protein_decay * proteins
        protein_rate[0] += push
        return state + np.concatenate((messenger_rate, protein_rate))

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        return float((next_state[3] - self.reference(self.n_steps + 1)) ** 2), False

    def _error(self) -> float:
        return abs(float(self.state[3]) - self.reference(self.n_steps))

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        axes.set(xlim=(-1.0, 15.5), ylim=(-4.5, 17.5), aspect="auto")
        # The ring of proteins, each of which represses the next; their areas are the concentrations
        places, present = [(3.9, 13.0), (6.6, 1.5), (1.2, 1.5)], self.n_steps
        *sizes, goal = 6.0 * np.sqrt([*states[-1, 3:], self.reference(present)])
        for index, place in enumerate(places):
            repressed = (index + 1) % 3
            line = {"arrowstyle": "-[, widthB=0.7, lengthB=0", "color": "0.6", "linewidth": 2}
            shrink = {"shrinkA": sizes[index] / 2 + 8, "shrinkB": sizes[repressed] / 2 + 8}
            axes.annotate("", places[repressed], place, arrowprops={**line, **shrink})
            axes.plot(*place, "o", color="tab:blue" if index else "tab:orange", markersize=sizes[index])
            axes.text(*place, self.state_names[3 + index], ha="center", va="center", fontsize="large")
        axes.plot(*places[0], "o", color="tab:green", markersize=goal, markerfacecolor="none", markeredgewidth=3)
        # The first protein until now, and its reference
        steps, protein = np.arange(-150, 51), states[-151:, 3]
        axes.plot(13.5 + steps / 30.0, [self.reference(present + step) for step in steps], color="tab:green", linewidth=4)
        axes.plot(13.5 - np.arange(len(protein))[::-1] / 30.0, protein, color="tab:orange", linewidth=1.5)
        axes.plot(13.5, protein[-1], "o", color="tab:orange", markersize=8)
