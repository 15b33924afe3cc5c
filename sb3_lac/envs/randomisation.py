import inspect
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from numbers import Integral, Real
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

#: By name the smallest and the largest value
Ranges = Mapping[str, Sequence[float]]


class Randomisation:
    """Numbers that each episode samples anew, uniformly and independently, each within its range."""

    def __init__(self, ranges: Ranges, present: Mapping[str, float]) -> None:
        if unknown := ranges.keys() - present.keys():
            raise ValueError(f"drawn has {sorted(unknown)}, which are none of {sorted(present)}.")
        for name, ends in ranges.items():
            values = np.array(ends)
            if values.shape != (2,) or values.dtype.kind not in "iuf" or not -np.inf < values[0] <= values[1] < np.inf:
                raise ValueError(f"drawn[{name!r}]={ends!r} must be the smallest and the largest value, two finite numbers.")
        #: All of them at their smallest, and at their largest
        self.smallest, self.largest = ({name: ends[end] for name, ends in ranges.items()} for end in (0, 1))
        # Where the present value and both ends are whole numbers, so are those that are sampled, the ends among them
        self._is_whole = {
            name: isinstance(present[name], Integral) and all(float(end).is_integer() for end in ends)
            for name, ends in ranges.items()
        }

    def sample(self, generator: np.random.Generator) -> dict[str, float]:
        """Sample all of them."""
        return {
            name: (
                int(generator.integers(int(low), int(self.largest[name]), endpoint=True))
                if self._is_whole[name]
                else float(generator.uniform(low, self.largest[name]))
            )
            for name, low in self.smallest.items()
        }


class DomainRandomization(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """
    Domain randomisation of any environment: each episode samples attributes of ``env.unwrapped`` anew. The cost environments
    have their own argument ``drawn`` for this.

    .. code-block:: python

      env = DomainRandomization(gym.make("Pendulum-v1"), {"m": (0.8, 1.2), "l": (0.8, 1.2)})
      _, info = env.reset(seed=0)
      print(info["drawn"])

    The attributes must be numbers that the environment reads in each step: a copy, for example inside a simulator, stays
    unchanged. Name nested attributes by their path, such as ``"model.opt.gravity[2]"`` and ``"model.body_mass[1]"`` of MuJoCo.
    For a factor of a whole array, give the environment a property that sets the array, and randomise the property.

    :param env: The environment
    :param drawn: Smallest and largest value of each attribute, in its unit; sampled uniformly, as integers if the attribute
        and both limits are integers
    :raises ValueError: If an attribute is not a number of the environment, or a range is invalid
    """

    def __init__(self, env: gym.Env[Any, Any], drawn: Ranges) -> None:
        RecordConstructorArgs.__init__(self, drawn=drawn)
        super().__init__(env)
        plant = env.unwrapped
        numbers = {name: inspect.getattr_static(plant, name) for name in dir(plant) if not name.startswith("_")}
        numbers = {name: value for name, value in numbers.items() if _is_number(value)}
        for name in drawn.keys() - numbers.keys():
            with suppress(AttributeError, LookupError, TypeError):
                owner, part = _place(plant, name)
                value = owner[part] if _has_items(owner) else getattr(owner, part)
                if np.size(value) > 1:
                    raise ValueError(
                        f"{name} has {np.size(value)} numbers. Randomise one of them, as {name}[0], or give the environment "
                        "a property that sets all of them, and randomise that."
                    )
                if _is_number(value):
                    numbers[name] = value
        self._randomisation = Randomisation(drawn, numbers)
        self._generator = np.random.default_rng()
        self._sampled: dict[str, float] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Randomise, and start an episode; ``info["drawn"]`` says what was sampled, here and after each step."""
        if seed is not None:
            # Not the numbers of the environment once more, which has this seed, too
            self._generator = np.random.default_rng((seed, 1))
        self._sampled = self._randomisation.sample(self._generator)
        for name, value in self._sampled.items():
            owner, part = _place(self.env.unwrapped, name)
            if _has_items(owner):
                owner[part] = value
            else:
                setattr(owner, part, value)
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "drawn": dict(self._sampled)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Move on by one step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "drawn": dict(self._sampled)}


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _has_items(owner: Any) -> bool:
    return isinstance(owner, (np.ndarray, list, dict))


def _place(plant: Any, name: str) -> tuple[Any, Any]:
    """Find the object that a path like ``model.body_mass[1]`` ends in, and the name or the index there."""
    *path, last = [int(part) if part.isdigit() else part for part in re.findall(r"[^.\[\]]+", name)]
    for part in path:
        plant = plant[part] if _has_items(plant) else getattr(plant, part)  # type: ignore[arg-type]
    return plant, last
